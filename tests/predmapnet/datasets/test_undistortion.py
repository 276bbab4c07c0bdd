"""Distorted images become those of a pinhole: checked against OpenCV's own projections."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mapfusion.geometry import inverse_pose
from predmapnet.datasets.images import read_camera_image
from predmapnet.datasets.undistortion import BROWN_CONRADY, KANNALA_BRANDT, undistorted, undistorted_camera
from predmapnet.errors import UserError
from predmapnet.scenes import Camera

WIDTH, HEIGHT = 320, 200
LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def stored_camera(focal: float, pitch: float = 0.0, roll: float = 0.0) -> Camera:
    """A camera that looks ahead and ``pitch`` degrees down; its principal point lies a little off the middle."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("yx", [pitch, roll], degrees=True).as_matrix() @ LEVEL
    pose[:3, 3] = 1.0, 0.2, 1.5
    intrinsics = np.array([[focal, 0.0, WIDTH / 2 + 3], [0.0, focal * 1.02, HEIGHT / 2 - 2], [0.0, 0.0, 1.0]])
    return Camera("eye", WIDTH, HEIGHT, intrinsics, pose)


def opencv_pixels(camera: Camera, model: str, distortion: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Pixels (ours, first centre at 0.5) of points ``(n, 3)`` of the ego frame, by OpenCV alone."""
    ego_to_camera = inverse_pose(camera.camera_to_ego)
    seen = points @ ego_to_camera[:3, :3].T + ego_to_camera[:3, 3]
    nothing = np.zeros((1, 3))
    if model == KANNALA_BRANDT:
        return cv2.fisheye.projectPoints(seen[:, None], nothing, nothing, camera.intrinsics, distortion)[0][:, 0]
    return cv2.projectPoints(seen, nothing, nothing, camera.intrinsics, distortion)[0][:, 0]


LENSES = st.one_of(
    st.tuples(
        st.just(BROWN_CONRADY),
        st.tuples(
            st.floats(-0.3, 0.1), st.floats(0.0, 0.05), st.floats(-2e-3, 2e-3), st.floats(-2e-3, 2e-3), st.just(0.0)
        ),
        st.floats(260.0, 400.0),
        st.just((0.0, 0.0)),
    ),
    st.tuples(
        st.just(KANNALA_BRANDT),
        st.tuples(st.floats(-0.05, 0.05), st.floats(-0.01, 0.01), st.floats(-1e-3, 1e-3), st.floats(-1e-4, 1e-4)),
        st.floats(90.0, 160.0),
        st.tuples(st.floats(-10.0, 50.0), st.floats(-15.0, 15.0)),
    ),
)


@settings(max_examples=25, deadline=None)
@given(LENSES, st.integers(0, 2**31))
def test_a_pixel_shows_what_opencv_sees_there(lens, seed):
    """The stored image holds its own coordinates, so that the undistorted one says where each pixel came from."""
    model, coefficients, focal, (pitch, roll) = lens
    distortion = np.array(coefficients)
    stored = stored_camera(focal, pitch, roll)
    camera = undistorted_camera(stored, model, distortion, "here")
    column, row = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    ramps = np.stack([column / WIDTH * 250, row / HEIGHT * 250, np.full((HEIGHT, WIDTH), 255)], axis=-1)
    picture = undistorted(np.round(ramps).astype(np.uint8), camera)
    assert picture.shape == (camera.height, camera.width, 3)

    cells = np.random.default_rng(seed).integers(0, [camera.width, camera.height], (400, 2))
    rays = np.column_stack([cells + 0.5, np.ones(400)]) @ np.linalg.inv(camera.intrinsics).T
    points = 10.0 * rays @ camera.camera_to_ego[:3, :3].T + camera.camera_to_ego[:3, 3]
    expected = opencv_pixels(stored, model, distortion, points)
    seen = (np.abs(expected - [WIDTH / 2, HEIGHT / 2]) < [WIDTH / 2 - 2, HEIGHT / 2 - 2]).all(axis=1)
    red, green, blue = picture[cells[seen, 1], cells[seen, 0]].T.astype(float)
    assert seen.sum() > 100 and (blue > 250).all()
    errors = np.stack([red / 250 * WIDTH, green / 250 * HEIGHT], axis=1) + 0.5 - expected[seen]
    # A grey level stands for 1.3 pixels across, so one error says little, and their mean much.
    assert np.abs(errors).max() < 1.2
    assert np.abs(errors.mean(axis=0)).max() < 0.3


def test_a_camera_without_distortion_keeps_its_images():
    image = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
    assert undistorted(image, stored_camera(300.0)) is image


def test_a_fisheye_becomes_as_wide_as_networks_look_and_no_wider():
    stored = stored_camera(WIDTH / np.radians(190.0))
    camera = undistorted_camera(stored, KANNALA_BRANDT, np.zeros(4), "here")
    half = np.degrees(np.arctan(camera.width / 2 / camera.intrinsics[0, 0]))
    assert half == pytest.approx(60.0, abs=0.5)
    assert np.degrees(camera.sector.field_of_view) == pytest.approx(120.0, abs=1.0)
    narrow = undistorted_camera(stored_camera(WIDTH / np.radians(70.0)), KANNALA_BRANDT, np.zeros(4), "here")
    assert np.degrees(narrow.sector.field_of_view) == pytest.approx(70.0, abs=1.0)


def test_a_fisheye_that_looks_down_is_levelled():
    camera = undistorted_camera(stored_camera(100.0, pitch=45.0, roll=10.0), KANNALA_BRANDT, np.zeros(4), "here")
    right, _, ahead = camera.camera_to_ego[:3, :3].T
    assert right[2] == pytest.approx(0.0, abs=1e-12)
    assert np.degrees(np.arcsin(-ahead[2])) == pytest.approx(12.0)
    # A lens that looks straight down has no heading to level to.
    below = stored_camera(100.0, pitch=89.0)
    np.testing.assert_array_equal(
        undistorted_camera(below, KANNALA_BRANDT, np.zeros(4), "here").camera_to_ego, below.camera_to_ego
    )


def test_what_a_lens_folds_over_stays_black_or_is_refused():
    # r (1 - 0.3 r^2) turns back at r = 1.05: the left corners of this image are seen by no ray.
    stored = stored_camera(150.0)
    with pytest.raises(UserError, match="folds"):
        undistorted_camera(stored, BROWN_CONRADY, np.array([-0.9, 0.0, 0.0, 0.0]), "cameras, eye")
    camera = undistorted_camera(stored_camera(234.0), BROWN_CONRADY, np.array([-0.3, 0.0, 0.0, 0.0]), "here")
    white = np.full((HEIGHT, WIDTH, 3), 255, dtype=np.uint8)
    picture = undistorted(white, camera)
    assert picture[picture.shape[0] // 2, WIDTH // 2].min() == 255 and picture[0, 0].max() == 0
    pixels, seen = camera.lens.project(np.array([[2.0, 0.0, 1.0], [0.0, 0.0, -1.0]]))
    assert np.isfinite(pixels).all() and not seen.any()


def test_stored_images_are_checked_by_the_size_of_the_lens(tmp_path):
    camera = undistorted_camera(stored_camera(100.0), KANNALA_BRANDT, np.zeros(4), "here")
    cv2.imwrite(str(tmp_path / "right.png"), np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8))
    assert read_camera_image(tmp_path / "right.png", camera).shape == (camera.height, camera.width, 3)
    cv2.imwrite(str(tmp_path / "wrong.png"), np.zeros((HEIGHT, WIDTH // 2, 3), dtype=np.uint8))
    with pytest.raises(UserError, match=f"{WIDTH} x {HEIGHT}"):
        read_camera_image(tmp_path / "wrong.png", camera)
