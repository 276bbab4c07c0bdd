"""Eq. 1 to 3: what a query may look at."""

import torch

from predmapnet.network.instance_masks import attention_cells
from predmapnet.network.layers import Attention


def test_cells_outside_the_mask_change_nothing():
    torch.manual_seed(0)
    attention = Attention(16, 4)
    query, tokens = torch.randn(1, 2, 16), torch.randn(1, 10, 16)
    allowed = torch.zeros(1, 2, 10, dtype=torch.bool)
    allowed[:, :, :4] = True
    before = attention(query, tokens, tokens, allowed)
    tokens[:, 4:] = 1e3 * torch.randn(1, 6, 16)
    torch.testing.assert_close(attention(query, tokens, tokens, allowed), before)
    tokens[:, 0] += 1.0
    assert (attention(query, tokens, tokens, allowed) - before).abs().max() > 1e-3


def test_mask_threshold_is_a_probability():
    logits = torch.tensor([-1.0, -0.1, 0.1, 3.0]).reshape(1, 1, 2, 2)
    assert attention_cells(logits, (2, 2), 0.5).tolist() == [[[False, False, True, True]]]


def test_a_query_with_an_empty_mask_attends_everywhere():
    logits = torch.stack([torch.full((2, 2), -5.0), torch.tensor([[5.0, -5.0], [-5.0, -5.0]])])[None]
    assert attention_cells(logits, (2, 2), 0.5).tolist() == [[[True] * 4, [True, False, False, False]]]


def test_a_line_one_cell_wide_survives_on_a_coarser_level():
    logits = torch.full((1, 1, 26, 52), -5.0)
    logits[0, 0, 11, 20] = 5.0
    allowed = attention_cells(logits, (13, 26), 0.5).reshape(13, 26)
    assert allowed.nonzero().tolist() == [[5, 10]]
