"""A log folder is read with the right geometry: pixels, poses, instants, and what is true in each frame."""

import json
import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mapfusion.elements import ElementKind, RegionOfInterest
from mapfusion.geometry import inverse_pose, transform_points
from predmapnet.errors import UserError
from predmapnet.scenes import Camera
from tests.real_roads.log_folder import LogScene, Poses, image_path, nearest, write_poses, write_rig
from tests.real_roads.street import truth_of_lines

LANDMARK = np.array([10.0, 10.0])
"""A point on the road, global frame; the road is the plane z = 0."""
ABOVE_ROAD = 0.28
DELAY = 60_000_000


def looking_ahead() -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    pose[:3, 3] = 1.4, 0.1, 1.2
    return pose


def drive() -> Poses:
    """Straight on at 12 m/s with a heading of 30 degrees, the ego origin 0.28 m above the road."""
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("z", 30, degrees=True).as_matrix()
    poses[:, :2, 3] = 1.2 * np.arange(4)[:, None] * [np.cos(np.pi / 6), np.sin(np.pi / 6)]
    poses[:, 2, 3] = ABOVE_ROAD
    return Poses(10**18 + 100_000_000 * np.arange(4, dtype=np.int64), poses)


def written(folder: Path) -> LogScene:
    """A log by OpenCV's convention whose images hold one white pixel where the landmark is."""
    poses, mounting = drive(), looking_ahead()
    focal, cx, cy = 300.0, 159.5, 89.5
    camera_above = Camera("eye", 320, 180, np.eye(3), mounting, -ABOVE_ROAD)
    write_rig(folder / "calibration.json", (camera_above,))
    content = json.loads((folder / "calibration.json").read_text())
    content["cameras"]["eye"]["intrinsics"] = {"fx": focal, "fy": focal, "cx": cx, "cy": cy}
    (folder / "calibration.json").write_text(json.dumps(content))
    write_poses(folder / "poses.csv", poses)
    for stamp in poses.timestamps.tolist():
        taken = stamp + DELAY
        pose = poses.at(taken)
        point = inverse_pose(pose @ mounting) @ [*LANDMARK, 0.0, 1.0]
        column, row = focal * point[0] / point[2] + cx, focal * point[1] / point[2] + cy
        image = np.zeros((180, 320), dtype=np.uint8)
        # OpenCV's pixel (column, row) is a centre: a landmark at 12.0 lights pixel 12.
        image[round(row), round(column)] = 255
        path = image_path(folder, "eye", taken)
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), image, [cv2.IMWRITE_JPEG_QUALITY, 100])
    line = LANDMARK + np.array([[-5, 0], [0, 0], [0, 4]])
    return LogScene(folder, truth_of_lines([(ElementKind.BOUNDARY, line)], poses))


@pytest.fixture
def scene(tmp_path):
    return written(tmp_path)


def projection_error(scene: LogScene, index: int) -> float:
    """Pixels between where the truth of a frame projects and where its image shows it (our convention)."""
    frame = scene.frame(index)
    truth = scene.truth(index, RegionOfInterest())
    (camera,) = frame.rig
    corner = truth.polylines[0][np.argmin(np.linalg.norm(
        transform_points(frame.ego_to_global, truth.polylines[0]) - LANDMARK, axis=1))]  # fmt: skip
    point = (inverse_pose(camera.camera_to_ego) @ [*corner, camera.ground_height, 1.0])[:3]
    projected = camera.intrinsics @ point
    image = cv2.imread(str(frame.images["eye"]), cv2.IMREAD_GRAYSCALE)
    row, column = np.unravel_index(np.argmax(image), image.shape)
    return float(np.abs(projected[:2] / projected[2] - [column + 0.5, row + 0.5]).max())


@pytest.mark.parametrize("index", [0, 1, 2])
def test_a_true_point_projects_into_its_pixel(scene, index):
    # A lit pixel is known to half a pixel; the error is that of rounding alone.
    assert projection_error(scene, index) <= 0.5 + 1e-3


def test_the_projection_test_notices_the_usual_mistakes(scene):
    def mean_error(changed: LogScene) -> float:
        return float(np.mean([projection_error(changed, index) for index in range(3)]))

    right = mean_error(scene)
    assert mean_error(LogScene(scene.folder, scene.known_truth, own_instants=False)) > right + 1.0
    inverted = LogScene(scene.folder, scene.known_truth)
    inverted.mounted = tuple(replace(c, camera_to_ego=inverse_pose(c.camera_to_ego)) for c in scene.mounted)
    assert mean_error(inverted) > right + 10.0
    high = LogScene(scene.folder, scene.known_truth)
    high.mounted = tuple(replace(camera, ground_height=0.0) for camera in scene.mounted)
    assert mean_error(high) > right + 1.0


def test_principal_points_move_by_half_a_pixel(scene):
    np.testing.assert_allclose(scene.rig[0].intrinsics[:2, 2], [160.0, 90.0])
    assert scene.rig[0].ground_height == -ABOVE_ROAD


def test_calibration_and_poses_come_back_as_they_were_written(tmp_path, scene):
    write_rig(tmp_path / "calibration.json", scene.rig)
    write_poses(tmp_path / "poses.csv", scene.poses)
    again = LogScene(tmp_path)
    np.testing.assert_allclose(again.rig[0].intrinsics, scene.rig[0].intrinsics)
    np.testing.assert_allclose(again.rig[0].camera_to_ego, scene.rig[0].camera_to_ego, atol=1e-12)
    np.testing.assert_allclose(again.poses.ego_to_global, scene.poses.ego_to_global, atol=1e-9)
    np.testing.assert_array_equal(again.poses.timestamps, scene.poses.timestamps)


def test_poses_between_instants_lie_on_the_way_and_are_held_at_the_ends(scene):
    poses = scene.poses
    halfway = poses.at(int(poses.timestamps[1]) + 50_000_000)
    np.testing.assert_allclose(halfway[:3, 3], poses.ego_to_global[1:3, :3, 3].mean(axis=0), atol=1e-9)
    np.testing.assert_allclose(poses.at(int(poses.timestamps[-1]) + 10**9), poses.ego_to_global[-1], atol=1e-9)


def test_an_image_that_is_too_far_in_time_does_not_belong_to_the_frame():
    stamps = np.array([10**18, 10**18 + 10**9])
    assert nearest(stamps, 10**18 + 90_000_000) == 10**18
    assert nearest(stamps, 10**18 + 500_000_000) is None
    assert nearest(stamps[:0], 10**18) is None


def test_a_folder_that_is_no_log_is_refused(tmp_path):
    with pytest.raises(UserError, match=r"calibration\.json"):
        LogScene(tmp_path)


@pytest.mark.reference
def test_the_real_street_opens_and_its_lines_lie_in_view():
    from tests.real_roads.street import open_street

    root = Path(os.environ.get("PREDMAPNET_REFERENCE", Path(__file__).parents[3] / "shared/reference/public"))
    if not (root / "real_street").is_dir():
        pytest.skip(f"no real_street under {root}; set PREDMAPNET_REFERENCE")
    street = open_street(root / "real_street")
    frame = street.frame(len(street) // 2)
    assert set(frame.images) == {camera.name for camera in frame.rig}
    kinds = street.truth(frame.index, RegionOfInterest()).kinds
    assert {ElementKind.DIVIDER, ElementKind.BOUNDARY} <= set(kinds.tolist())
