"""Images and calibration of a bag: pixels in their colours, lenses, rectified and cropped images, frames of a body."""

import json

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mapfusion.geometry import inverse_pose
from predmapnet.datasets.bags.cameras import _names, _of_size
from predmapnet.datasets.bags.conversion import log_from_bag
from predmapnet.datasets.bags.image_messages import RAW, image_file
from predmapnet.datasets.own_logs.scene import LogScene
from predmapnet.errors import UserError
from tests.predmapnet.datasets.bags.drawn_bag import camera_info, raw, tf, transform
from tests.predmapnet.datasets.own_logs.drawn_log import entry

COLOURS = np.array([[[200, 40, 30], [30, 180, 60]], [[20, 60, 220], [120, 120, 120]]], dtype=np.uint8)
"""Red, green, blue and grey quarters."""
PICTURE = np.repeat(np.repeat(COLOURS, 32, axis=0), 48, axis=1)


def mosaic(pattern: str) -> np.ndarray:
    """What a sensor with a pattern such as ``rggb`` sees of the picture."""
    image = np.zeros(PICTURE.shape[:2], dtype=np.uint8)
    for place, letter in enumerate(pattern):
        row, column = divmod(place, 2)
        image[row::2, column::2] = PICTURE[row::2, column::2, "rgb".index(letter)]
    return image


def yuv(order: str) -> np.ndarray:
    """The picture with a luma for each pixel and chroma for each pair."""
    luma, red, blue = np.moveaxis(cv2.cvtColor(PICTURE, cv2.COLOR_RGB2YCrCb), -1, 0)
    # OpenCV reads YUV 4:2:2 of a smaller range than YCrCb has.
    luma = (16 + luma * (219 / 255)).astype(np.uint8)
    chroma = np.where(np.arange(luma.shape[1]) % 2 == 0, blue, red)
    chroma = np.round(128 + (chroma.astype(float) - 128) * (224 / 255)).astype(np.uint8)
    return np.stack([chroma, luma] if order == "uyvy" else [luma, chroma], axis=-1)


ENCODINGS = {
    "rgb8": PICTURE,
    "bgr8": PICTURE[..., ::-1],
    "8UC3": PICTURE[..., ::-1],
    "rgba8": np.dstack([PICTURE, np.full(PICTURE.shape[:2], 9, dtype=np.uint8)]),
    "bgra8": np.dstack([PICTURE[..., ::-1], np.full(PICTURE.shape[:2], 9, dtype=np.uint8)]),
    **{f"bayer_{pattern}8": mosaic(pattern) for pattern in ("rggb", "bggr", "gbrg", "grbg")},
    **dict.fromkeys(("yuv422", "uyvy"), yuv("uyvy")),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), yuv("yuyv")),
}


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("padding", [0, 7])
def test_raw_images_keep_their_colours(encoding, padding):
    data, ending = image_file(raw(ENCODINGS[encoding], encoding, 1, "camera", padding), RAW)
    assert ending == ".jpg"
    image = cv2.cvtColor(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
    assert image.shape == PICTURE.shape
    for row in (16, 48):
        for column in (24, 72):
            np.testing.assert_allclose(image[row, column].astype(int), PICTURE[row, column].astype(int), atol=6)


@pytest.mark.parametrize("encoding", ["mono8", "8UC1"])
def test_raw_images_in_grey(encoding):
    data, _ = image_file(raw(PICTURE[..., 1], encoding, 1, "camera", 3), RAW)
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_allclose(image[10, 10], PICTURE[10, 10, 1], atol=3)


def test_raw_images_that_are_not_known_or_not_whole_are_told():
    message = raw(PICTURE, "rgb16", 1, "camera")
    with pytest.raises(UserError, match=r"'rgb16'; known are bgr8"):
        image_file(message, RAW)
    message = raw(PICTURE, "rgb8", 1, "camera")
    message.data = message.data[:-1]
    with pytest.raises(UserError, match="not whole"):
        image_file(message, RAW)


OPTICAL_TO_BODY = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
"""Columns are the axes of a body (x ahead, y left, z up) in those of a camera."""


def matrix_of(stamped) -> np.ndarray:
    t, q = stamped.transform.translation, stamped.transform.rotation
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), [t.x, t.y, t.z]
    return pose


def calibration(drawn, tmp_path):
    report = log_from_bag(drawn.write(tmp_path / "bag"), tmp_path / "out")
    return json.loads((tmp_path / "out" / "calibration.json").read_text())["cameras"], report


@pytest.mark.parametrize(
    ("model", "said", "written"),
    [
        ("plumb_bob", [-0.1, 0.01, 1e-3, 2e-3, 0.0], [-0.1, 0.01, 1e-3, 2e-3, 0.0]),
        ("plumb_bob", [-0.1, 0.01, 0.0, 0.0], [-0.1, 0.01, 0.0, 0.0, 0.0]),
        ("rational_polynomial", [0.1, 0.02, 0, 0, 0.01, 0.1, 0.02], [0.1, 0.02, 0, 0, 0.01, 0.1, 0.02, 0]),
        ("equidistant", [0.01, -0.002, 0.0, 0.0], [0.01, -0.002, 0.0, 0.0]),
        ("equidistant", [0.0] * 5, [0.0] * 4),
        ("fisheye", [0.0] * 4, [0.0] * 4),
        ("plumb_bob", [0.0] * 5, None),
        ("", [], None),
    ],
)
def test_lenses_are_taken_over(drawn, tmp_path, model, said, written):
    def edit(message):
        message.distortion_model, message.d = model, np.array(said, dtype=float)

    drawn.change("/sensing/left/camera_info", edit)
    cameras, _ = calibration(drawn, tmp_path)
    assert cameras["left"].get("distortion") == written
    assert cameras["left"]["model"] == (model if written else "pinhole")
    lens = {camera.name: camera.lens for camera in LogScene(tmp_path / "out").rig}["left"]
    assert (lens is None) == (written is None)


def test_rectified_images_have_the_projection_without_distortion_and_the_turned_axes(drawn, tmp_path):
    turn = cv2.Rodrigues(np.array([0.02, -0.05, 0.01]))[0]
    for side in ("front", "left"):
        topic = f"/sensing/{side}/image_raw/compressed"
        rectified = [(topic.replace("_raw", "_rect"), *rest) for _, *rest in drawn.of(topic)]
        drawn.drop(topic)
        drawn.messages += rectified

        def edit(message):
            message.d = np.array([-0.3, 0.1, 0.0, 0.0, 0.0])
            message.r = turn.ravel()
            message.p = np.array([70.0, 0.0, 81.0, -7.0, 0.0, 71.0, 47.0, 0.0, 0.0, 0.0, 1.0, 0.0])

        drawn.change(f"/sensing/{side}/camera_info", edit)
    cameras, _ = calibration(drawn, tmp_path)
    assert cameras["left"]["intrinsics"] == {"fx": 70.0, "fy": 71.0, "cx": 81.0, "cy": 47.0}
    assert "distortion" not in cameras["left"]
    # R takes points from the camera's own axes to those of the rectified image.
    plain = {"front": entry(0, 160, 96, 90.0), "left": entry(80, 160, 96, 90.0)}
    for camera in LogScene(tmp_path / "out").rig:
        w, x, y, z = plain[camera.name]["camera_to_ego"]["rotation_wxyz"]
        own = Rotation.from_quat([x, y, z, w]).as_matrix()
        point = np.array([3.0, 2.0, 1.0])
        np.testing.assert_allclose(camera.camera_to_ego[:3, :3].T @ point, turn @ own.T @ point, atol=1e-9)


def test_a_frame_with_the_axes_of_a_body_is_noticed(drawn, log, tmp_path):
    def edit(message):
        for one in message.transforms:
            if one.child_frame_id == "front_optical":
                one.child_frame_id = "front_link"
                pose = matrix_of(one)
                pose[:3, :3] = pose[:3, :3] @ OPTICAL_TO_BODY
                one.transform = transform("", "", 0, pose).transform

    drawn.change("/tf_static", edit)
    drawn.change("/sensing/front/camera_info", lambda message: setattr(message.header, "frame_id", "front_link"))
    _, report = calibration(drawn, tmp_path)
    assert any("front_link has x ahead and z up" in note for note in report.notes)
    found = {camera.name: camera for camera in LogScene(tmp_path / "out").rig}["front"]
    truth = {camera.name: camera for camera in LogScene(log).rig}["front"]
    np.testing.assert_allclose(found.camera_to_ego, truth.camera_to_ego, atol=1e-9)


sizes = st.integers(200, 2000)


@settings(max_examples=100, deadline=None)
@given(sizes, sizes, st.integers(1, 4), st.integers(1, 4), st.integers(0, 50), st.integers(0, 50), st.booleans())
def test_a_point_is_seen_in_its_pixel_of_a_cropped_and_binned_image(width, height, bx, by, left, top, cropped):
    """Pixels of the small image cover ``bx`` times ``by`` pixels of the sensor, from the corner of the region on."""
    info = camera_info(entry(0, width, height, 500.0), 1, "camera")
    info.binning_x, info.binning_y = bx, by
    region = (width - left, height - top) if cropped else (width, height)
    if cropped:
        info.roi.x_offset, info.roi.y_offset, info.roi.width, info.roi.height = left, top, *region
    matrix = _of_size(info.k.reshape(3, 3), info, region[0] // bx, region[1] // by)
    sensor = info.k.reshape(3, 3) @ [0.2, 0.1, 1.0]
    small = matrix @ [0.2, 0.1, 1.0]
    offset = np.array([left, top]) if cropped and (bx, by, left, top) != (1, 1, 0, 0) else np.zeros(2)
    expected = (sensor[:2] + 0.5 - offset) / [bx, by]
    np.testing.assert_allclose(small[:2] + 0.5, expected)


@pytest.mark.parametrize(
    ("topics", "names"),
    [
        (["/sensing/camera/front/image_raw", "/sensing/camera/rear/image_raw"], ["front", "rear"]),
        (["/camera0/image", "/camera1/image"], ["camera0", "camera1"]),
        (["/car/front/left/image", "/car/front/right/image", "/car/rear/image"], ["front_left", "front_right", "rear"]),
        (["/zed/left/image_raw"], ["left"]),
        (["/image_raw"], ["camera"]),
        (["/cam/image_a", "/cam/image_b"], ["cam_image_a", "cam_image_b"]),
        (["/cam/image", "/cam/wide/image"], ["cam", "cam_wide"]),
    ],
)
def test_cameras_have_short_names(topics, names):
    assert list(_names(topics).values()) == names


def test_the_way_between_frames_is_found_against_the_arrows_too(drawn, log, tmp_path):
    """As some calibrations have it: the car's frame hangs on a camera."""

    def turn_around(message):
        for one in message.transforms:
            if one.child_frame_id == "mast":
                one.transform = transform("", "", 0, inverse_pose(matrix_of(one))).transform
                one.child_frame_id, one.header.frame_id = "base_link", "mast"

    drawn.change("/tf_static", turn_around)
    calibration(drawn, tmp_path)
    for found, truth in zip(LogScene(tmp_path / "out").rig, LogScene(log).rig, strict=True):
        np.testing.assert_allclose(found.camera_to_ego, truth.camera_to_ego, atol=1e-9)


def test_wrong_transforms_are_left_out_and_told(drawn, tmp_path):
    time = drawn.of("/tf")[0][1]
    wrong = transform("odom", "base_link", time, np.eye(4))
    wrong.transform.rotation.w = 0.0
    drawn.messages.append(("/tf", time, tf([wrong])))
    _, report = calibration(drawn, tmp_path)
    assert any("1 transforms are no rigid motion" in note for note in report.notes)
