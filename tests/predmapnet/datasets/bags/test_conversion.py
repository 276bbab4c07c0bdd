"""A bag becomes the log that it was made from, whatever its storage and however it says where the car was."""

import json
import shutil

import cv2
import numpy as np
import pytest

from predmapnet.datasets.bags.conversion import BagOptions, log_from_bag
from predmapnet.datasets.own_logs.scene import LogScene
from predmapnet.errors import UserError
from tests.predmapnet.datasets.bags.drawn_bag import (
    compressed,
    moved,
    odometry,
    raw,
    tf,
    transform,
)

FRONT, LEFT = "/sensing/front/image_raw/compressed", "/sensing/left/image_raw/compressed"


def assert_same(found, log, images=True):
    """The log in ``found`` is the one in ``log``."""
    one, other = LogScene(found, 1000.0), LogScene(log, 1000.0)
    assert len(one) == len(other)
    assert sorted(camera.name for camera in one.rig) == sorted(camera.name for camera in other.rig)
    rig = {camera.name: camera for camera in other.rig}
    for camera in one.rig:
        same = rig[camera.name]
        assert (camera.width, camera.height) == (same.width, same.height)
        np.testing.assert_allclose(camera.intrinsics, same.intrinsics)
        np.testing.assert_allclose(camera.camera_to_ego, same.camera_to_ego, atol=1e-9)
        assert camera.ground_height == pytest.approx(same.ground_height)
    for index in range(len(one)):
        here, there = one.frame(index), other.frame(index)
        assert here.timestamp == there.timestamp
        np.testing.assert_allclose(here.ego_to_global, there.ego_to_global, atol=1e-6)
        for name, path in there.images.items():
            assert here.images[name].name == path.name
            assert not images or here.images[name].read_bytes() == path.read_bytes()


@pytest.mark.parametrize(
    ("storage", "compression"),
    [
        ("mcap", "none"),
        ("mcap", "storage"),
        ("mcap", "file"),
        ("sqlite3", "none"),
        ("sqlite3", "file"),
        ("sqlite3", "message"),
    ],
)
def test_a_bag_becomes_the_log_that_it_was_made_from(drawn, log, tmp_path, storage, compression):
    bag = drawn.write(tmp_path / "bag", storage, compression)
    seen = []
    report = log_from_bag(bag, tmp_path / "out", progress=lambda done, total, what: seen.append((done, total)))
    assert_same(tmp_path / "out", log)
    assert report.images == {"front": 12, "left": 12}
    assert report.cameras == {"front": FRONT, "left": LEFT}
    assert report.poses == "transforms from base_link to map, 12 poses, 10 Hz"
    assert report.notes == []
    assert seen[-1][0] == seen[-1][1]


def test_one_file_of_a_bag_is_enough_and_a_recording_that_was_not_ended(drawn, log, tmp_path):
    bag = drawn.write(tmp_path / "bag")
    (file,) = bag.glob("*.mcap")
    log_from_bag(file, tmp_path / "one")
    assert_same(tmp_path / "one", log)
    (bag / "metadata.yaml").unlink()
    log_from_bag(bag, tmp_path / "whole")
    assert_same(tmp_path / "whole", log)


def test_a_bag_of_several_files_is_one(drawn, log, tmp_path):
    parts = [drawn.messages[:20], drawn.messages[20:]]
    folder = tmp_path / "bag"
    folder.mkdir()
    for number, drawn.messages in enumerate(parts):
        (file,) = drawn.write(tmp_path / f"part_{number}", "sqlite3").glob("*.db3")
        shutil.move(file, folder)
    log_from_bag(folder, tmp_path / "out")
    assert_same(tmp_path / "out", log)


def of_log(log):
    return LogScene(log).poses


def with_odometry(drawn, log, child, offset, topic="/odom", frame="odom"):
    """Take the car's transforms away and say where something on it is, ``offset`` from the car's frame."""
    drawn.drop("/tf")
    add_odometry(drawn, log, child, offset, topic, frame)


def add_odometry(drawn, log, child, offset, topic, frame):
    poses = of_log(log)
    for time, pose in zip(poses.timestamps.tolist(), poses.ego_to_global, strict=True):
        drawn.messages.append((topic, time + 5, odometry(frame, child, time, pose @ offset)))


@pytest.mark.parametrize("child", ["base_link", "", "/imu"])
def test_odometry_tells_where_the_car_was(drawn, log, tmp_path, child):
    offset = moved(0.4, 0.2, 0.1, 0.7) if child == "/imu" else np.eye(4)
    with_odometry(drawn, log, child, offset)
    start = int(of_log(log).timestamps[0])
    drawn.messages.append(("/tf_static", start, tf([transform("base_link", "imu", 0, offset)])))
    report = log_from_bag(drawn.write(tmp_path / "bag"), tmp_path / "out")
    assert_same(tmp_path / "out", log)
    assert "odometry /odom" in report.poses


def test_the_odometry_in_the_map_is_preferred_and_another_can_be_named(drawn, log, tmp_path):
    with_odometry(drawn, log, "base_link", np.eye(4), "/localization", "map")
    localised = drawn.of("/localization")
    with_odometry(drawn, log, "base_link", moved(0.0, 0.0, 9.0), "/a_drifting_one", "odom")
    assert localised == drawn.of("/localization")
    bag = drawn.write(tmp_path / "bag")
    assert "/localization" in log_from_bag(bag, tmp_path / "out").poses
    assert_same(tmp_path / "out", log)
    assert "/a_drifting_one" in log_from_bag(bag, tmp_path / "named", BagOptions(poses="/a_drifting_one")).poses
    assert LogScene(tmp_path / "named").poses.ego_to_global[0, 2, 3] == pytest.approx(9.3)


def test_poses_in_a_frame_or_of_a_topic_of_the_same_name(drawn, log, tmp_path):
    add_odometry(drawn, log, "base_link", moved(0.0, 0.0, 9.0), "/odom", "odom")
    bag = drawn.write(tmp_path / "bag")
    log_from_bag(bag, tmp_path / "topic", BagOptions(poses="/odom"))
    assert LogScene(tmp_path / "topic").poses.ego_to_global[0, 2, 3] == pytest.approx(9.3)
    log_from_bag(bag, tmp_path / "out", BagOptions(poses="odom"))
    expected = np.linalg.inv(moved(10.0, -3.0, 0.5, 0.4)) @ of_log(log).ego_to_global[0]
    np.testing.assert_allclose(LogScene(tmp_path / "out").poses.ego_to_global[0], expected, atol=1e-6)


def test_transforms_at_rates_of_their_own_are_interpolated_where_all_are_known(drawn, log, tmp_path):
    # The drift is known at every third instant only, and no longer at the end.
    kept = [entry for entry in drawn.of("/tf") if entry[2].transforms[0].header.frame_id == "map"][:10:3]
    rest = [entry for entry in drawn.of("/tf") if entry[2].transforms[0].header.frame_id == "odom"]
    drawn.drop("/tf")
    drawn.messages += kept + rest
    log_from_bag(drawn.write(tmp_path / "bag"), tmp_path / "out")
    found, truth = LogScene(tmp_path / "out").poses, of_log(log)
    np.testing.assert_array_equal(found.timestamps, truth.timestamps[:10])
    np.testing.assert_allclose(found.ego_to_global, truth.ego_to_global[:10], atol=2e-3)


def test_another_frame_of_the_car_and_its_height(drawn, log, tmp_path):
    options = BagOptions(base_frame="mast", height=1.25)
    report = log_from_bag(drawn.write(tmp_path / "bag"), tmp_path / "out", options)
    calibration = json.loads((tmp_path / "out" / "calibration.json").read_text())
    assert calibration["ego_origin_above_road_m"] == 1.25
    expected = of_log(log).ego_to_global @ moved(0.5, 0.0, 1.0, 0.3)
    np.testing.assert_allclose(LogScene(tmp_path / "out").poses.ego_to_global, expected, atol=1e-6)
    assert report.notes == []


def test_a_height_that_nothing_tells_is_said(drawn, tmp_path):
    drawn.change("/tf_static", lambda message: message.transforms.pop(0))
    report = log_from_bag(drawn.write(tmp_path / "bag"), tmp_path / "out")
    assert any("--height" in note for note in report.notes)
    assert json.loads((tmp_path / "out" / "calibration.json").read_text())["ego_origin_above_road_m"] == 0.0


def test_headers_without_a_time_take_that_of_the_recording(drawn, tmp_path):
    def without_time(message):
        message.header.stamp.sec = message.header.stamp.nanosec = 0

    drawn.change(LEFT, without_time)
    report = log_from_bag(drawn.write(tmp_path / "bag"), tmp_path / "out")
    times = sorted(int(path.stem) for path in (tmp_path / "out" / "images" / "left").iterdir())
    assert times == [time for _, time, _ in drawn.of(LEFT)]
    assert any(LEFT in note and "no time" in note for note in report.notes)


def test_images_of_one_time_are_counted(drawn, tmp_path):
    drawn.messages += drawn.of(LEFT)[:2]
    notes = log_from_bag(drawn.write(tmp_path / "bag"), tmp_path / "out").notes
    assert any("2 images have the time of another" in note for note in notes)


def test_of_several_topics_of_a_camera_the_stored_and_compressed_one_is_taken(drawn, log, tmp_path):
    time = int(of_log(log).timestamps[0])
    picture = np.zeros((96, 160, 3), dtype=np.uint8)
    jpeg = cv2.imencode(".jpg", picture)[1].tobytes()
    drawn.messages += [
        ("/sensing/front/image_raw", time, raw(picture, "rgb8", time, "front_optical")),
        ("/sensing/front/image_rect/compressed", time, compressed(jpeg, time, "front_optical")),
        ("/detections/picture", time, raw(picture, "rgb8", time, "")),
    ]
    bag = drawn.write(tmp_path / "bag")
    report = log_from_bag(bag, tmp_path / "out")
    assert_same(tmp_path / "out", log)
    left_out = " / ".join(report.notes)
    assert all(
        name in left_out for name in ("/sensing/front/image_raw:", "image_rect/compressed:", "/detections/picture")
    )
    named = log_from_bag(bag, tmp_path / "named", BagOptions(("/sensing/front/image_raw",)))
    assert named.cameras == {"front": "/sensing/front/image_raw"}
    with pytest.raises(UserError, match="no camera info belongs to it"):
        log_from_bag(bag, tmp_path / "wrong", BagOptions(("/detections/picture", FRONT)))
    with pytest.raises(UserError, match=r"/front is no image topic; there are: .*/detections/picture"):
        log_from_bag(bag, tmp_path / "wrong", BagOptions(("/front",)))


def drop_static(drawn, child):
    drawn.change("/tf_static", lambda message: message.transforms.__setitem__(
        slice(None), [one for one in message.transforms if one.child_frame_id != child]))  # fmt: skip


def set_info(**fields):
    def edit(drawn):
        for side in ("front", "left"):
            drawn.change(f"/sensing/{side}/camera_info", lambda m: [setattr(m, k, v) for k, v in fields.items()])

    return edit


def set_images(**fields):
    def edit(drawn):
        for topic in (FRONT, LEFT):
            drawn.change(topic, lambda message: [setattr(message, k, v) for k, v in fields.items()])

    return edit


def without_infos(drawn):
    drawn.drop("/sensing/front/camera_info")
    drawn.drop("/sensing/left/camera_info")


def without_mast(drawn):
    drop_static(drawn, "mast")


def moving_mast(drawn):
    drop_static(drawn, "mast")
    for row, (_, time, _) in enumerate(drawn.of(FRONT)):
        drawn.messages.append(("/tf", time, tf([transform("base_link", "mast", time, moved(0.5, 0, 1 + 0.1 * row))])))


def with_base_renamed(drawn):
    def edit(message):
        for one in message.transforms:
            one.child_frame_id = one.child_frame_id.replace("base_", "chassis_")
            one.header.frame_id = one.header.frame_id.replace("base_", "chassis_")

    drawn.change("/tf", edit)
    drawn.change("/tf_static", edit)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (without_infos, r"no camera info belongs to it \(camera infos: none\)"),
        (without_mast, "no transform leads from front_optical to base_link"),
        (moving_mast, "front_optical moves against base_link"),
        (lambda drawn: drawn.drop("/tf"), "Nothing says where base_link was.*odometry: none"),
        (with_base_renamed, "--base-frame; there are: .*chassis_link"),
        (set_info(distortion_model="double_sphere"), "distortion model 'double_sphere' is not known.*equidistant"),
        (set_info(k=np.zeros(9)), "not calibrated"),
        (set_info(width=1920), "have 160 x 96 pixels, but its camera info is for 1920 x 96"),
        (set_info(d=np.arange(9.0)), "list of 4 or 5"),
        (set_images(data=np.frombuffer(b"\0\0\0\1h264", np.uint8), format="h264"), "'h264', neither JPEG nor PNG"),
        (set_images(format="16UC1; compressedDepth png"), "no pictures"),
        (set_images(format="bayer_rggb8; jpeg compressed "), "no pictures"),
    ],
)
def test_what_a_bag_lacks_is_told_with_what_is_there(drawn, tmp_path, change, message):
    change(drawn)
    bag = drawn.write(tmp_path / "bag")
    with pytest.raises(UserError, match=message) as caught:
        log_from_bag(bag, tmp_path / "out")
    assert str(bag) in str(caught.value)
    assert "calibration.json" in str(caught.value) or f"{FRONT} (sensor_msgs/msg/CompressedImage)" in str(caught.value)
    assert not (tmp_path / "out").exists() and list(tmp_path.iterdir()) == [bag]


def test_a_frame_that_is_not_there_is_told(drawn, tmp_path):
    bag = drawn.write(tmp_path / "bag")
    for options in (BagOptions(base_frame="chassis"), BagOptions(poses="utm")):
        with pytest.raises(UserError, match=r"(chassis|utm).*base_link"):
            log_from_bag(bag, tmp_path / "out", options)


def test_clocks_that_differ_are_told(drawn, tmp_path):
    def later(message):
        message.header.stamp.sec += 1000

    drawn.change(FRONT, later)
    drawn.change(LEFT, later)
    with pytest.raises(UserError, match="no image of front lies between poses"):
        log_from_bag(drawn.write(tmp_path / "bag"), tmp_path / "out")


@pytest.mark.parametrize(
    ("name", "message"), [("drive.bag", "rosbags-convert"), ("x.txt", "no ROS 2 bag"), ("", "no ROS 2")]
)
def test_what_is_no_bag_is_told(tmp_path, name, message):
    path = tmp_path / "given"
    path.mkdir()
    if name:
        (path / name).write_bytes(b"#ROSBAG V2.0\n")
        path = path / name
    with pytest.raises(UserError, match=message):
        log_from_bag(path, tmp_path / "out")
    with pytest.raises(UserError, match="There is no bag"):
        log_from_bag(tmp_path / "missing.mcap", tmp_path / "out")


def test_a_folder_that_is_there_is_kept(drawn, tmp_path):
    (tmp_path / "out").mkdir()
    with pytest.raises(UserError, match="exists already"):
        log_from_bag(drawn.write(tmp_path / "bag"), tmp_path / "out")


@pytest.mark.parametrize("what", ["MB looked through", "MB written"])
def test_stopping_leaves_nothing(drawn, tmp_path, what):
    bag = drawn.write(tmp_path / "bag")

    def stop(done, total, stage):
        if stage == what:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        log_from_bag(bag, tmp_path / "out", progress=stop)
    assert list(tmp_path.iterdir()) == [bag]
