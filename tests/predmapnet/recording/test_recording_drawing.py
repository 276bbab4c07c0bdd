"""Lines in pictures: what the recording draws lies where it belongs."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapfusion.colours import KIND_COLOURS
from mapfusion.elements import RegionOfInterest
from predmapnet.recording.blueprint import Extent
from predmapnet.recording.palette import raster_picture
from predmapnet.recording.projection import bev_pixels, dashes, project_line, true_runs
from predmapnet.scenes import Camera

FORWARD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Camera axes (x right, y down, z forward) in the ego frame of a camera that looks ahead."""


@pytest.fixture
def front_camera() -> Camera:
    pose = np.eye(4)
    pose[:3, :3] = FORWARD
    pose[2, 3] = 1.5
    intrinsics = np.array([[400.0, 0.0, 320.0], [0.0, 400.0, 180.0], [0.0, 0.0, 1.0]])
    return Camera("CAM_FRONT", 640, 360, intrinsics, pose)


def test_a_line_ahead_is_seen_where_the_pinhole_says(front_camera):
    (part,) = project_line(np.array([[10.0, 2.0], [20.0, 2.0]]), front_camera)
    np.testing.assert_allclose(part[0], [320 - 400 * 2 / 10, 180 + 400 * 1.5 / 10])
    np.testing.assert_allclose(part[-1], [320 - 400 * 2 / 20, 180 + 400 * 1.5 / 20])


def test_what_is_behind_or_beside_the_camera_is_not_drawn(front_camera):
    assert project_line(np.array([[-20.0, 0.0], [-5.0, 0.0]]), front_camera) == []
    assert project_line(np.array([[5.0, 28.0], [6.0, 25.0]]), front_camera) == []


def test_a_line_from_behind_the_camera_is_cut_at_the_border_of_the_picture(front_camera):
    (part,) = project_line(np.array([[-10.0, 0.5], [30.0, 0.5]]), front_camera)
    assert (part >= 0).all()
    assert (part <= [640, 360]).all()
    np.testing.assert_allclose(part[:, 1].max(), 360)


def test_a_line_that_leaves_and_comes_back_makes_two_parts(front_camera):
    wide = np.array([[20.0, 4.0], [20.0, 40.0], [25.0, 40.0], [25.0, 4.0]])
    assert len(project_line(wide, front_camera)) == 2


@given(st.lists(st.booleans(), max_size=30))
def test_runs_cover_the_true_values_that_have_a_true_neighbour(values):
    mask = np.array(values, dtype=bool)
    covered = np.zeros_like(mask)
    for run in true_runs(mask):
        assert mask[run].all()
        covered[run] = True
    padded = np.pad(mask, 1)
    np.testing.assert_array_equal(covered, mask & (padded[:-2] | padded[2:]))


def test_dashes_cover_their_share_of_the_line():
    pieces = dashes(np.array([[0.0, 0.0], [12.0, 0.0]]), dash=0.7, gap=0.5)
    assert sum(np.linalg.norm(piece[1] - piece[0]) for piece in pieces) == pytest.approx(7.0)
    assert pieces[0].shape == (2, 2)


def test_bev_pixels_follow_the_grid_convention():
    corners = np.array([[-30.0, 15.0], [30.0, -15.0], [0.0, 0.0]])
    expected = [[0, 0], [400, 200], [200, 100]]
    np.testing.assert_allclose(bev_pixels(corners, RegionOfInterest(), (200, 400)), expected)


def test_the_strongest_raster_gives_the_colour():
    rasters = np.zeros((2, 2, 2), dtype=np.float32)
    rasters[0, 0, 0], rasters[1, 0, 0], rasters[1, 1, 1] = 0.4, 1.0, 1.0
    picture = raster_picture(rasters, np.array([0, 2]))
    assert tuple(picture[0, 0]) == KIND_COLOURS[2]
    assert picture[0, 1].max() < 30


def test_no_rasters_make_a_dark_picture():
    assert raster_picture(np.zeros((0, 4, 8), dtype=np.float32), np.zeros(0, dtype=np.int64)).shape == (4, 8, 3)


@pytest.mark.parametrize(("metres", "points"), [(500.0, 500.0), (20_000.0, 500.0), (50.0, 240.0)])
def test_a_map_on_earth_fills_its_panel_as_far_as_there_are_tiles(metres, points):
    """At 45 degrees of latitude, on tiles of 256 points that show the whole equator at zoom 0."""
    zoom = Extent((0.0, 0.0), metres, metres / 3).zoom
    metres_per_point = 40_075_016.7 / 256 * np.cos(np.radians(45)) / 2**zoom
    assert metres / metres_per_point == pytest.approx(points, rel=0.03)
