"""A network made for inference says what it said before."""

import torch
from torch import nn

from predmapnet.config import SmallBackboneConfig
from predmapnet.network.kernels.inference import for_inference
from predmapnet.network.maptracker.resnet import ResNet50
from predmapnet.network.small.backbone import ImageBackbone


def with_any_statistics(network: nn.Module) -> nn.Module:
    """Norms that do something, as if they had been trained."""
    torch.manual_seed(0)
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            nn.init.uniform_(module.weight, 0.5, 1.5)
            nn.init.normal_(module.bias)
            nn.init.normal_(module.running_mean)
            nn.init.uniform_(module.running_var, 0.5, 2.0)
    return network.eval()


def assert_same_without_norms(network: nn.Module, images: torch.Tensor) -> None:
    before = {name: value.clone() for name, value in network.state_dict().items()}
    faster = for_inference(network)
    with torch.no_grad():
        found, expected = faster(images), network(images)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-4 * float(other.abs().max()))
    assert not any(isinstance(module, nn.BatchNorm2d) for module in faster.modules())
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())


def test_norms_of_the_small_backbone_are_folded():
    assert_same_without_norms(with_any_statistics(ImageBackbone(SmallBackboneConfig())), torch.randn(2, 3, 64, 96))


def test_norms_of_the_deformable_backbone_are_folded():
    assert_same_without_norms(with_any_statistics(ResNet50()), torch.randn(1, 3, 64, 96))


def test_norm_and_codes_of_the_whole_network_are_computed_once(network, make_inputs):
    network = with_any_statistics(network)
    faster = for_inference(network)
    inputs = make_inputs(1)
    with torch.no_grad():
        expected, found, again = network(inputs), faster(inputs), faster(inputs)
    assert isinstance(faster.bev_encoder.norm, nn.Identity) and len(faster.query_generator.cell_code.known) > 0
    assert network.query_generator.cell_code.known is None
    for name in ("queries", "segmentation", "bev"):
        one, other = getattr(found, name), getattr(expected, name)
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-4 * float(other.abs().max()))
        assert torch.equal(getattr(again, name), one)
