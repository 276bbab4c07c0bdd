"""Tensor polylines against the plain versions of mapfusion."""

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mapfusion.elements import RegionOfInterest
from mapfusion.geometry import chamfer_distance, clip_line, resample
from predmapnet.network.polylines import chamfer_distances, clip_polylines, resample_polylines

ROI = RegionOfInterest(60.0, 30.0)
SIZE = torch.tensor([60.0, 30.0], dtype=torch.float64)
seeds = st.integers(0, 10**6)


def walk(seed, count=12, step=6.0):
    generator = np.random.default_rng(seed)
    heading = generator.uniform(-np.pi, np.pi) + np.cumsum(generator.normal(0, 0.4, count))
    start = generator.uniform(-1, 1, 2) * ROI.size * 0.6
    return start + np.cumsum(step * np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)


@settings(max_examples=30, deadline=None)
@given(seeds, st.integers(2, 40))
def test_resampling_agrees_with_mapfusion(seed, count):
    line = walk(seed)
    found = resample_polylines(torch.from_numpy(line), count).numpy()
    np.testing.assert_allclose(found, resample(line, count), atol=1e-9)


def test_a_line_without_length_repeats_its_point():
    line = torch.full((3, 5, 2), 0.3)
    assert torch.equal(resample_polylines(line, 7), torch.full((3, 7, 2), 0.3))


@settings(max_examples=60, deadline=None)
@given(seeds)
def test_clipping_a_line_agrees_with_mapfusion_when_it_stays_in_one_piece(seed):
    line = walk(seed)
    parts = clip_line(line, ROI)
    normalised = torch.from_numpy(line / ROI.size + 0.5)
    found, inside = clip_polylines(normalised, torch.tensor(False), SIZE)
    assert bool(inside) == bool(parts)
    assert found.min() >= 0 and found.max() <= 1
    if len(parts) == 1:
        expected = resample(parts[0], len(line))
        np.testing.assert_allclose((found.numpy() - 0.5) * ROI.size, expected, atol=1e-6)


def test_a_ring_that_leaves_the_roi_is_pressed_against_its_border_and_stays_closed():
    ring = torch.tensor([[0.9, 0.4], [1.1, 0.4], [1.1, 0.6], [0.9, 0.6], [0.9, 0.4]], dtype=torch.float64)
    found, inside = clip_polylines(ring, torch.tensor(True), SIZE)
    assert bool(inside)
    torch.testing.assert_close(found[0], found[-1])
    assert found[:, 0].max() == 1.0 and found[:, 0].min() >= 0.9 - 1e-9


def test_a_ring_outside_is_gone():
    ring = torch.tensor([[1.2, 0.4], [1.3, 0.4], [1.3, 0.6], [1.2, 0.4]])
    assert not clip_polylines(ring, torch.tensor(True), SIZE.float())[1]


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_chamfer_agrees_with_mapfusion(seed):
    first, second = walk(seed), walk(seed + 1)
    found = chamfer_distances(torch.from_numpy(first)[None], torch.from_numpy(second)[None])
    np.testing.assert_allclose(float(found[0]), chamfer_distance(first, second), rtol=1e-9)
