"""A log of one's own is read with the right geometry: pixels, poses, instants, and what is true in each frame."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mapfusion.elements import ElementKind, RegionOfInterest
from mapfusion.geometry import inverse_pose, transform_points
from predmapnet.datasets.own_logs.calibration import write_rig
from predmapnet.datasets.own_logs.scene import LogScene
from predmapnet.datasets.own_logs.source import LogSource
from predmapnet.datasets.own_logs.timed_poses import TimedPoses, write_timed_poses
from predmapnet.errors import UserError
from predmapnet.scenes import Camera
from predmapnet.sources import folder_named, only_scene, open_source

LANDMARK = np.array([10.0, 10.0])
"""A point on the road, global frame; the road is the plane z = 0."""
ABOVE_ROAD = 0.28
START, PERIOD, DELAY = 1_500_000_000_000_000_000, 100_000_000, 40_000_000
FOCAL, CX, CY = 300.0, 159.5, 89.5
EVERY_IMAGE = 1000.0


def looking(yaw: float, x: float) -> np.ndarray:
    """A camera that looks ``yaw`` degrees to the left."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", yaw, degrees=True).as_matrix() @ [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    pose[:3, 3] = x, 0.1, 1.2
    return pose


def drive() -> TimedPoses:
    """Straight on at 12 m/s with a heading of 30 degrees, the ego origin 0.28 m above the road."""
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("z", 30, degrees=True).as_matrix()
    poses[:, :2, 3] = 1.2 * np.arange(6)[:, None] * [np.cos(np.pi / 6), np.sin(np.pi / 6)]
    poses[:, 2, 3] = ABOVE_ROAD
    return TimedPoses(START + PERIOD * np.arange(6, dtype=np.int64), poses)


def lit(pose: np.ndarray, mounting: np.ndarray) -> np.ndarray:
    """What a camera of OpenCV's convention sees of the landmark: pixel (column, row) is a centre, 12.0 lights 12."""
    image = np.zeros((180, 320), dtype=np.uint8)
    point = inverse_pose(pose @ mounting) @ [*LANDMARK, 0.0, 1.0]
    column, row = FOCAL * point[0] / point[2] + CX, FOCAL * point[1] / point[2] + CY
    image[round(row), round(column)] = 255
    return image


def save(folder: Path, camera: str, timestamp: int, image: np.ndarray) -> None:
    path = folder / "images" / camera / f"{timestamp}.jpg"
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), image, [cv2.IMWRITE_JPEG_QUALITY, 100])


@pytest.fixture
def folder(tmp_path):
    """A log of two cameras: ``ahead`` at the instants of the poses, ``eye`` 40 ms later, with the landmark in it."""
    folder = tmp_path / "drive"
    folder.mkdir()
    poses, mounting = drive(), looking(8.0, 1.4)
    cameras = (
        Camera("eye", 320, 180, np.eye(3), mounting, -ABOVE_ROAD),
        Camera("ahead", 320, 180, np.eye(3), looking(0.0, 1.5), -ABOVE_ROAD),
    )
    write_rig(folder / "calibration.json", cameras)
    edit(folder, lambda cameras: [entry.update(intrinsics=dict(fx=FOCAL, fy=FOCAL, cx=CX, cy=CY))
                                  for entry in cameras.values()])  # fmt: skip
    write_timed_poses(folder / "poses.csv", poses)
    for stamp in poses.timestamps.tolist():
        save(folder, "ahead", stamp, np.zeros((180, 320), dtype=np.uint8))
        save(folder, "eye", stamp + DELAY, lit(poses.at(stamp + DELAY), mounting))
    line = (LANDMARK + np.array([[-5, 0], [0, 0], [0, 4]])).tolist()
    (folder / "truth.json").write_text(json.dumps({"elements": [{"kind": "boundary", "points": line}]}))
    return folder


def edit(folder: Path, change) -> None:
    """Change the cameras of ``calibration.json``."""
    content = json.loads((folder / "calibration.json").read_text())
    change(content["cameras"])
    (folder / "calibration.json").write_text(json.dumps(content))


def projection_error(scene: LogScene, index: int) -> float:
    """Pixels between where the truth of a frame projects and where the eye shows it (our convention)."""
    frame = scene.frame(index)
    line = scene.truth(index, RegionOfInterest()).polylines[0]
    eye = next(camera for camera in frame.rig if camera.name == "eye")
    corner = line[np.argmin(np.linalg.norm(transform_points(frame.ego_to_global, line) - LANDMARK, axis=1))]
    point = (inverse_pose(eye.camera_to_ego) @ [*corner, eye.ground_height, 1.0])[:3]
    projected = eye.intrinsics @ point
    image = cv2.imread(str(frame.images["eye"]), cv2.IMREAD_GRAYSCALE)
    row, column = np.unravel_index(np.argmax(image), image.shape)
    return float(np.abs(projected[:2] / projected[2] - [column + 0.5, row + 0.5]).max())


def mean_error(scene: LogScene) -> float:
    return float(np.mean([projection_error(scene, index) for index in range(3)]))


def test_a_true_point_projects_into_its_pixel(folder):
    # A lit pixel is known to half a pixel; the error is that of rounding alone.
    scene = LogScene(folder, EVERY_IMAGE)
    assert max(projection_error(scene, index) for index in range(3)) <= 0.5 + 1e-3


def test_the_projection_test_notices_the_usual_mistakes(folder):
    right = mean_error(LogScene(folder, EVERY_IMAGE))
    at_once = LogScene(folder, EVERY_IMAGE)
    still = replace(at_once.poses, ego_to_global=at_once.poses.ego_to_global[:1].repeat(6, axis=0))
    at_once.poses = still
    assert mean_error(at_once) > right + 10.0
    inverted = LogScene(folder, EVERY_IMAGE)
    inverted.rig = tuple(replace(c, camera_to_ego=inverse_pose(c.camera_to_ego)) for c in inverted.rig)
    assert mean_error(inverted) > right + 10.0
    high = LogScene(folder, EVERY_IMAGE)
    high.rig = tuple(replace(camera, ground_height=0.0) for camera in high.rig)
    assert mean_error(high) > right + 1.0


def test_a_camera_stands_where_it_was_at_its_own_instant(folder):
    scene = LogScene(folder, EVERY_IMAGE)
    eye, ahead = scene.frame(2).rig
    # 40 ms at 12 m/s.
    np.testing.assert_allclose(eye.camera_to_ego[:3, 3], [1.4 + 0.48, 0.1, 1.2], atol=1e-6)
    np.testing.assert_array_equal(ahead.camera_to_ego, scene.rig[1].camera_to_ego)


def test_principal_points_move_by_half_a_pixel(folder):
    eye, _ = LogScene(folder).rig
    np.testing.assert_allclose(eye.intrinsics[:2, 2], [160.0, 90.0])
    assert eye.ground_height == -ABOVE_ROAD


def test_calibration_and_poses_come_back_as_they_were_written(folder):
    scene = LogScene(folder)
    write_rig(folder / "calibration.json", scene.rig)
    write_timed_poses(folder / "poses.csv", scene.poses)
    again = LogScene(folder)
    np.testing.assert_allclose(again.rig[0].intrinsics, scene.rig[0].intrinsics)
    np.testing.assert_allclose(again.rig[0].camera_to_ego, scene.rig[0].camera_to_ego, atol=1e-12)
    np.testing.assert_allclose(again.poses.ego_to_global, scene.poses.ego_to_global, atol=1e-9)
    np.testing.assert_array_equal(again.poses.timestamps, scene.poses.timestamps)


def test_frames_come_at_the_rate_from_the_camera_that_looks_ahead(folder):
    offsets = [(LogScene(folder, rate).timestamps - START).tolist() for rate in (1000.0, 5.0, 2.0, 0.1)]
    assert offsets[0] == [PERIOD * row for row in range(6)]
    assert offsets[1] == [0, 2 * PERIOD, 4 * PERIOD]
    assert offsets[2] == [0, 5 * PERIOD]
    assert offsets[3] == [0]


def test_uneven_instants_keep_the_rate(folder):
    # 10 Hz, every second image 1 ms early: at 5 Hz still every second one.
    for row, path in enumerate(sorted((folder / "images" / "ahead").iterdir())):
        path.rename(path.with_stem(str(int(path.stem) - 1_000_000 * (row % 4 == 2))))
    assert len(LogScene(folder, 5.0)) == 3


def test_late_images_are_missing_and_said_never_paired(folder):
    (folder / "images" / "eye" / f"{START + 2 * PERIOD + DELAY}.jpg").unlink()
    (folder / "images" / "eye" / f"{START + PERIOD + DELAY}.jpg").unlink()
    scene = LogScene(folder, EVERY_IMAGE)
    assert "eye" in scene.frame(0).images and "eye" in scene.frame(3).images
    # Frame 1 is 60 ms after the image of frame 0; frame 2 is 160 ms after it and 140 ms before the next.
    assert scene.frame(1).images["eye"].stem == str(START + DELAY)
    frame = scene.frame(2)
    assert "eye" not in frame.images and "0.14 s away" in frame.missing["eye"] and "0.1 s" in frame.missing["eye"]
    for path in (folder / "images" / "eye").iterdir():
        path.unlink()
    assert LogScene(folder).frame(0).missing == {"eye": "the log holds none"}


def test_images_without_a_pose_make_no_frame_and_are_counted(folder):
    for step in (10, 11):
        save(folder, "ahead", START + step * PERIOD, np.zeros((180, 320), dtype=np.uint8))
    scene = LogScene(folder, EVERY_IMAGE)
    assert len(scene) == 6
    assert "2 of 8 images of ahead left out" in scene.info.description


def test_a_clock_may_begin_with_the_drive(folder):
    poses = drive()
    write_timed_poses(folder / "poses.csv", replace(poses, timestamps=poses.timestamps - START + 10**9))
    for path in sorted((folder / "images").glob("*/*.jpg")):
        path.rename(path.with_stem(str(int(path.stem) - START + 10**9)))
    assert LogScene(folder, EVERY_IMAGE).timestamps[0] == 10**9


def test_poses_of_another_clock_are_refused(folder):
    poses = drive()
    write_timed_poses(folder / "poses.csv", replace(poses, timestamps=poses.timestamps - 10**16))
    with pytest.raises(UserError, match="between poses"):
        LogScene(folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda cameras: cameras["eye"].pop("width"), "width"),
        (lambda cameras: cameras["eye"]["intrinsics"].update(fx="wide"), "finite number"),
        (lambda cameras: cameras["eye"]["intrinsics"].update(cx=1600), "scaled"),
        (lambda cameras: cameras["eye"]["camera_to_ego"].update(rotation_wxyz=[1, 1, 0, 0]), "rigid"),
        (lambda cameras: cameras["eye"].pop("camera_to_ego"), "camera_to_ego"),
        (lambda cameras: cameras.update({"../eye": cameras["eye"]}), "name of a camera"),
        (lambda cameras: cameras.clear(), "describes each camera"),
        (lambda cameras: cameras.update({f"more{n}": cameras["eye"] for n in range(8)}), "10 cameras"),
        # A camera to the left, by its quaternion in the order x, y, z, w.
        (lambda cameras: [entry["camera_to_ego"].update(rotation_wxyz=[0.5**0.5, 0, 0, -(0.5**0.5)])
                          for entry in cameras.values()], "x, y, z, w"),
    ],
)  # fmt: skip
def test_a_wrong_calibration_is_refused_with_its_place(folder, change, message):
    edit(folder, change)
    with pytest.raises(UserError, match=message) as caught:
        LogScene(folder)
    assert "calibration.json" in str(caught.value)


@pytest.mark.parametrize("height", [1500.0, -300.0])
def test_an_origin_far_from_the_road_is_refused(folder, height):
    path = folder / "calibration.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "ego_origin_above_road_m": height}))
    with pytest.raises(UserError, match=r"calibration\.json.* above the road"):
        LogScene(folder)


@pytest.mark.parametrize("name", ["truth.json", "truth.geojson", "georeference.json"])
def test_a_link_to_nothing_or_a_folder_is_no_lack_of_a_file(folder, name):
    (folder / "truth.json").unlink(missing_ok=True)
    (folder / name).symlink_to("nowhere.json")
    with pytest.raises((OSError, UserError), match="No such file"):
        LogScene(folder).truth_map()
    (folder / name).unlink()
    (folder / name).mkdir()
    with pytest.raises((OSError, UserError), match=r"[Ii]s a directory"):
        LogScene(folder).truth_map()


@pytest.mark.parametrize("name", ["calibration.json", "poses.csv"])
def test_a_missing_file_is_named(folder, name):
    (folder / name).unlink()
    with pytest.raises(UserError, match=name):
        LogScene(folder)


def test_crossings_are_cut_as_areas_and_whatever_lies_outside_is_left_out(folder):
    ring = [[-80, -2], [2, -2], [2, 2], [-80, 2]]
    elements = [{"kind": "ped_crossing", "points": ring}, {"kind": "divider", "points": [[90, 0], [99, 0]]}]
    (folder / "truth.json").write_text(json.dumps({"elements": elements}))
    truth = LogScene(folder).truth(0, RegionOfInterest())
    assert truth.kinds.tolist() == [ElementKind.PED_CROSSING]
    np.testing.assert_array_equal(truth.polylines[0][0], truth.polylines[0][-1])
    # The band of 4 m leaves the region over its side, 15 m to the left.
    assert truth.polylines[0].min(axis=0)[0] == pytest.approx(-29.98, abs=1e-2)
    assert truth.polylines[0].max(axis=0)[1] == pytest.approx(15.0)
    whole = LogScene(folder).truth_map()
    assert len(whole) == 2 and len(whole.elements[0].points) == 5


def test_truth_lies_right_however_high_above_the_sea_and_steep_the_road_is(folder):
    poses = drive()
    pitched = poses.ego_to_global @ np.block(
        [[Rotation.from_euler("y", -5, degrees=True).as_matrix(), np.zeros((3, 1))], [0, 0, 0, 1]]
    )
    pitched[:, 2, 3] += 800.0
    write_timed_poses(folder / "poses.csv", replace(poses, ego_to_global=pitched))
    scene = LogScene(folder)
    truth = scene.truth(0, RegionOfInterest())
    back = transform_points(scene.instant(0).ego_to_global, truth.polylines[0])
    assert np.linalg.norm(back - LANDMARK, axis=1).min() < 1e-6


def test_broken_truth_is_told(folder):
    for text in ("[]", '{"elements": [{"kind": "wall", "points": [[0, 0], [1, 1]]}]}',
                 '{"elements": [{"kind": "divider", "points": [[0, 0]]}]}',
                 '{"elements": [{"kind": "divider", "points": [[0, 0], [NaN, 1]]}]}'):  # fmt: skip
        (folder / "truth.json").write_text(text)
        with pytest.raises(UserError, match=r"truth\.json"):
            LogScene(folder).truth_map()


def test_a_log_and_a_folder_of_logs_are_guessed_from_a_path(folder, tmp_path):
    assert folder_named(str(folder), None) == ("log", folder)
    assert folder_named("drive", None) is None
    source, sentence = open_source(None, folder)
    assert source.name == "log" and "log" in sentence
    assert only_scene(source) == "drive"
    (tmp_path / "train").mkdir()
    folder.rename(tmp_path / "train" / "first")
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "calibration.json").write_text("{}")
    infos = {info.name: info for info in open_source("log", tmp_path, rate=5.0)[0].scenes()}
    assert infos["first"].split == "train" and infos["first"].frames == 3
    assert not infos["broken"].ready and "cameras" in infos["broken"].description
    with pytest.raises(UserError, match="2 scenes"):
        only_scene(LogSource(tmp_path))
    with pytest.raises(UserError, match="first"):
        LogSource(tmp_path).open("frist")


def test_frames_are_found_by_their_tokens(folder):
    source = LogSource(folder)
    token = source.open("drive").frame(0).token
    assert source.scenes_of([token, "elsewhere_12"]) == {token: "drive"}


def test_a_rate_is_for_own_logs_alone(tmp_path):
    with pytest.raises(UserError, match="--rate"):
        open_source("demo", tmp_path, rate=4.0)
