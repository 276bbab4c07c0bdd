"""Rasters of hand-made elements, and normalised points."""

from __future__ import annotations

import numpy as np
import torch

from mapfusion.elements import ElementKind, RegionOfInterest
from predmapnet.scenes import FrameTruth
from predmapnet.training.data.targets import draw_element, truth_targets

ROI = RegionOfInterest(60.0, 30.0)


def test_row_zero_is_the_far_left() -> None:
    mask = np.zeros((100, 200), np.uint8)
    draw_element(mask, np.array([[20.0, 14.0], [29.0, 14.0]]), ElementKind.DIVIDER, ROI)
    rows, columns = np.nonzero(mask)
    assert rows.max() < 6, "large y (left of the car) is at the top"
    assert columns.min() > 160, "large x (ahead of the car) is at the right"


def test_a_line_is_three_cells_thick_around_its_course() -> None:
    mask = np.zeros((100, 200), np.uint8)
    # The middle of row 49 (rows count down from y = 15): y = 15 - 49.5 * 0.3.
    draw_element(mask, np.array([[-30.0, 0.15], [30.0, 0.15]]), ElementKind.BOUNDARY, ROI)
    assert mask.any(axis=1).nonzero()[0].tolist() == [48, 49, 50]
    assert mask[49].all()


def test_a_crossing_is_filled() -> None:
    mask = np.zeros((100, 200), np.uint8)
    ring = np.array([[0, 0], [6, 0], [6, 3], [0, 3], [0, 0]], dtype=float)
    draw_element(mask, ring, ElementKind.PED_CROSSING, ROI)
    assert mask[43, 105] == 1, "its middle"
    assert abs(int(mask.sum()) - 20 * 10) <= 2 * (20 + 10) + 4, "its area, up to the cells on its rim"


def test_targets_of_a_batch() -> None:
    line = np.array([[-30.0, -15.0], [30.0, 15.0]])
    ring = np.array([[0, 0], [6, 0], [6, 3], [0, 3], [0, 0]], dtype=float)
    nothing = FrameTruth(np.zeros(0, np.int64), (), np.zeros(0, np.int64))
    full = FrameTruth(np.array([1, 0]), (line, ring), np.array([4, 9]))
    targets = truth_targets([nothing, full], ROI, 20, (100, 200))
    assert targets.frame.tolist() == [1, 1]
    assert targets.element_ids.tolist() == [4, 9]
    assert torch.allclose(targets.points[0, [0, -1]], torch.tensor([[0.0, 0.0], [1.0, 1.0]]))
    assert torch.equal(targets.points[1, 0], targets.points[1, -1])
    assert not targets.segmentation[0].any()
    assert torch.equal(targets.segmentation[1, 1], targets.masks[0])
    assert torch.equal(targets.segmentation[1, 0], targets.masks[1])
