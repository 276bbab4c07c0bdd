"""The equations of Sec. 3.3 as properties."""

import torch

from mapfusion.elements import RegionOfInterest
from predmapnet.config import HistoryMapConfig
from predmapnet.network.history_memory import HistoryRasterMapMemory

MEMORY = HistoryRasterMapMemory(HistoryMapConfig(beta=0.9), RegionOfInterest(60.0, 30.0))


def forward_motion(x: float, y: float = 0.0) -> torch.Tensor:
    """Motion that maps the current frame to the past one, when the car has moved by (x, y)."""
    return torch.tensor([[[1.0, 0.0, x], [0.0, 1.0, y]]])


def test_a_new_instance_begins_with_its_mask_times_its_score():
    masks = torch.rand(1, 2, 25, 50)
    scores = torch.tensor([[0.8, 0.5]])
    nothing = torch.zeros(1, 0, 25, 50)
    maps = MEMORY.update(masks, scores, nothing, torch.zeros(1, 2, dtype=torch.long), torch.zeros(1, 2).bool())
    torch.testing.assert_close(maps, masks * torch.tensor([0.8, 0.5])[None, :, None, None])


def test_a_continued_instance_blends_old_and_new_and_a_lost_one_is_gone():
    masks, warped = torch.rand(1, 2, 25, 50), torch.rand(1, 3, 25, 50)
    scores = torch.tensor([[0.8, 0.5]])
    maps = MEMORY.update(masks, scores, warped, torch.tensor([[2, 0]]), torch.tensor([[True, False]]))
    assert maps.shape[1] == 2
    torch.testing.assert_close(maps[0, 0], 0.1 * warped[0, 2] + 0.9 * 0.8 * masks[0, 0])
    torch.testing.assert_close(maps[0, 1], 0.5 * masks[0, 1])


def test_driving_forward_moves_a_mask_back_by_the_right_cells():
    cell = 60.0 / 50
    maps = torch.zeros(1, 1, 25, 50)
    maps[0, 0, 10, 30] = 1.0
    moved = MEMORY.align(maps, forward_motion(3 * cell))
    assert moved[0, 0].argmax() == 10 * 50 + 27
    torch.testing.assert_close(moved[0, 0, 10, 27], torch.tensor(1.0), atol=1e-4, rtol=0)


def test_driving_left_moves_a_mask_down_by_the_right_cells():
    maps = torch.zeros(1, 1, 25, 50)
    maps[0, 0, 10, 30] = 1.0
    moved = MEMORY.align(maps, forward_motion(0.0, 2 * 30.0 / 25))
    assert moved[0, 0].argmax() == 12 * 50 + 30


def test_turning_half_round_turns_the_mask_about_the_car():
    maps = torch.zeros(1, 1, 25, 50)
    maps[0, 0, 3, 7] = 1.0
    turn = torch.tensor([[[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]])
    assert MEMORY.align(maps, turn)[0, 0].argmax() == (24 - 3) * 50 + (49 - 7)


def test_ground_that_was_out_of_sight_is_empty():
    moved = MEMORY.align(torch.ones(1, 1, 25, 50), forward_motion(12.0))
    assert moved[0, 0, :, -9:].abs().max() == 0.0
    assert moved[0, 0, 5:20, 5:35].min() > 0.999
