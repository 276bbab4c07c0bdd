"""The fast way to multiply many rows gives what torch's own linear layer gives."""

import pytest
import torch
import torch.nn.functional as F

from predmapnet.network.kernels.matrix_product import MANY_PRODUCTS, MANY_ROWS, Linear, linear


@pytest.mark.parametrize("shape", [(2, MANY_ROWS), (1, 50, 100), (3, 1009), (7,), (0,), (4, 0)])
@pytest.mark.parametrize("bias", [True, False])
def test_rows_of_any_number_are_multiplied(shape, bias):
    torch.manual_seed(0)
    layer = Linear(256, 320, bias=bias)
    assert 2 * MANY_ROWS * layer.weight.numel() >= MANY_PRODUCTS
    tokens = torch.randn(*shape, 256, requires_grad=True)
    found, expected = layer(tokens), F.linear(tokens, layer.weight, layer.bias)
    assert found.shape == expected.shape
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-5)
    direction = torch.randn_like(expected)
    parameters = [tokens, *layer.parameters()]
    for one, other in zip(
        torch.autograd.grad(found, parameters, direction, retain_graph=True),
        torch.autograd.grad(expected, parameters, direction),
        strict=True,
    ):
        torch.testing.assert_close(one, other, atol=2e-3, rtol=1e-4)


def test_rows_need_not_lie_side_by_side_in_memory():
    torch.manual_seed(0)
    maps, weight = torch.randn(2, 256, 32, 40), torch.randn(128, 256)
    assert 2 * 32 * 40 * weight.numel() >= MANY_PRODUCTS
    found = linear(maps.permute(0, 2, 3, 1), weight)
    torch.testing.assert_close(found, torch.einsum("nchw,oc->nhwo", maps, weight), atol=1e-3, rtol=1e-4)
