"""Cameras of a bag: image topics, the camera info that belongs to each, and where the cameras sit on the car."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from os.path import commonpath
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mapfusion.arrays import Float
from predmapnet.datasets.bags.frame_graph import FrameGraph
from predmapnet.datasets.bags.image_messages import COMPRESSED
from predmapnet.datasets.own_logs.calibration import MODELS
from predmapnet.datasets.undistortion import KANNALA_BRANDT
from predmapnet.errors import UserError
from predmapnet.files import file_name

LENSES = {"": 0, "plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4, "fisheye": 4}
"""Distortion models of camera infos, and the coefficients that each has at least (they are filled up with zeros)."""

BODY_TO_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""From a camera's axes (z ahead) to those of a body (x ahead, z up)."""
UPWARDS = 0.7
"""A camera whose own z axis points up by more than this has the axes of a body."""


@dataclass(frozen=True)
class ImageTopic:
    """An image topic.

    Attributes:
        topic: its name.
        kind: type of its messages.
        frame: of the camera, as the first image says it.
        size: width and height, pixels; None if no image could be decoded.
        problem: why not.
    """

    topic: str
    kind: str
    frame: str
    size: tuple[int, int] | None
    problem: str = ""

    @property
    def base(self) -> str:
        """The topic that was compressed."""
        return self.topic.removesuffix("/compressed") if self.kind == COMPRESSED else self.topic

    @property
    def rectified(self) -> bool:
        """Whether the images are undistorted already, as image_proc names them."""
        return "rect" in self.base.rpartition("/")[2]


@dataclass(frozen=True)
class BagCamera:
    """A camera of a bag.

    Attributes:
        images: its topic.
        name: short and unique.
        info: topic of its camera info.
        entry: of ``calibration.json``.
        notes: what a user should know of it.
    """

    images: ImageTopic
    name: str
    info: str
    entry: dict[str, Any]
    notes: tuple[str, ...]


def cameras_of(
    topics: Iterable[ImageTopic],
    infos: Mapping[str, Any],
    graph: FrameGraph,
    base: str,
    asked: bool,
) -> tuple[list[BagCamera], list[str]]:
    """Choose cameras and describe them.

    Args:
        topics: image topics to choose from.
        infos: first message of each camera info topic.
        graph: frames of the bag.
        base: frame of the car.
        asked: the user named these topics, so none may be left out.

    Returns:
        The cameras, and why other topics were left out.

    Raises:
        UserError: no camera can be used, or one that was asked for cannot.
    """
    chosen: dict[str, ImageTopic] = {}
    left_out = []
    # Of several topics of one camera: stored images before rectified ones, compressed before raw ones.
    for topic in sorted(topics, key=lambda topic: (topic.rectified, topic.kind != COMPRESSED, topic.topic)):
        info = _info_topic(topic, infos)
        if info is None:
            known = ", ".join(infos) or "none"
            left_out.append(f"{topic.topic}: no camera info belongs to it (camera infos: {known})")
        elif info in chosen:
            left_out.append(f"{topic.topic}: {chosen[info].topic} shows the same camera ({info})")
        else:
            chosen[info] = topic
    names = _names([topic.base for topic in chosen.values()])
    cameras = []
    for info, topic in chosen.items():
        notes: list[str] = []
        try:
            entry = _entry(topic, infos[info], graph, base, notes)
        except UserError as error:
            left_out.append(f"{topic.topic}: {error}")
            continue
        cameras.append(BagCamera(topic, names[topic.base], info, entry, tuple(notes)))
    if not cameras or (asked and left_out):
        reasons = "; ".join(left_out) or "it holds no image topic"
        raise UserError(f"No camera of this bag can be used: {reasons}." if not cameras else f"{reasons}.")
    return sorted(cameras, key=lambda camera: camera.name), left_out


def _info_topic(topic: ImageTopic, infos: Mapping[str, Any]) -> str | None:
    """Return the camera info beside an image topic, or else the only one of the same frame."""
    space = topic.base
    while space := space.rpartition("/")[0]:
        if f"{space}/camera_info" in infos:
            return f"{space}/camera_info"
    same = [name for name, info in infos.items() if info.header.frame_id.strip("/") == topic.frame]
    return same[0] if len(same) == 1 else None


def _names(topics: list[str]) -> dict[str, str]:
    """Return a short name of each topic: without what all share at the beginning, and without the image's name."""
    spaces = {topic: PurePosixPath("/" + topic.strip("/")).parent for topic in topics}
    shared = PurePosixPath(commonpath(map(str, spaces.values()))) if spaces else PurePosixPath("/")
    if shared in spaces.values():
        shared = shared.parent
    short = {topic: "_".join(space.relative_to(shared).parts) or "camera" for topic, space in spaces.items()}
    unique = len(set(short.values())) == len(short)
    return {topic: file_name(name if unique else topic.strip("/").replace("/", "_")) for topic, name in short.items()}


def _entry(topic: ImageTopic, info: Any, graph: FrameGraph, base: str, notes: list[str]) -> dict[str, Any]:
    """Return the entry of ``calibration.json``; raises UserError if the bag does not say it."""
    if topic.size is None:
        raise UserError(topic.problem)
    width, height = topic.size
    matrix = np.array(info.p, dtype=np.float64).reshape(3, 4)[:, :3] if topic.rectified else np.array(info.k)
    matrix = _of_size(matrix.reshape(3, 3), info, width, height)
    frame = info.header.frame_id.strip("/") or topic.frame
    pose = graph.mounting(frame, base)
    if pose[2, 2] > UPWARDS:
        notes.append(f"{topic.topic}: its frame {frame} has x ahead and z up, as a body has, and is taken so")
        pose[:3, :3] = pose[:3, :3] @ BODY_TO_OPTICAL
    if topic.rectified:
        pose[:3, :3] = pose[:3, :3] @ np.array(info.r, dtype=np.float64).reshape(3, 3).T
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True).tolist()
    entry: dict[str, Any] = {
        "width": width,
        "height": height,
        "model": "pinhole",
        "intrinsics": {"fx": matrix[0, 0], "fy": matrix[1, 1], "cx": matrix[0, 2], "cy": matrix[1, 2]},
        "camera_to_ego": {"translation_m": pose[:3, 3].tolist(), "rotation_wxyz": [w, x, y, z]},
    }
    model = str(info.distortion_model)
    if model not in LENSES:
        known = ", ".join(name for name in LENSES if name)
        raise UserError(f"its distortion model '{model}' is not known; known are {known}")
    # A fisheye without distortion is no pinhole: its pixels count angles.
    if model and not topic.rectified and (any(info.d) or MODELS[model] == KANNALA_BRANDT):
        distortion = np.trim_zeros([float(value) for value in info.d], "b")
        entry |= {"model": model, "distortion": [*distortion, *[0.0] * (LENSES[model] - len(distortion))]}
    return entry


def _of_size(matrix: Float, info: Any, width: int, height: int) -> Float:
    """Return intrinsics of images of a size: of the whole sensor, or what region and binning leave of it."""
    if not matrix[0, 0] > 0.0 or not matrix[1, 1] > 0.0:
        raise UserError("its camera info has no focal length: the camera is not calibrated")
    roi = info.roi
    binning = np.array([max(int(info.binning_x), 1), max(int(info.binning_y), 1)])
    region = np.array([int(roi.width) or int(info.width), int(roi.height) or int(info.height)])
    for offset, size, factor in (([0, 0], [info.width, info.height], [1, 1]),
                                 ([roi.x_offset, roi.y_offset], region // binning, binning)):  # fmt: skip
        if [width, height] == [int(value) for value in size]:
            changed = matrix.copy()
            changed[:2, 2] = (matrix[:2, 2] + 0.5 - offset) / factor - 0.5
            changed[[0, 1], [0, 1]] = matrix[[0, 1], [0, 1]] / factor
            return changed
    raise UserError(
        f"its images have {width} x {height} pixels, but its camera info is for {info.width} x {info.height}"
    )
