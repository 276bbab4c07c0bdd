"""``calibration.json``: the cameras of a log of one's own."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mapfusion.arrays import Float
from predmapnet.datasets.fields import check_mounting, check_principal_point, numbers_field, text_field, whole_field
from predmapnet.datasets.large_tables import parse_json
from predmapnet.datasets.log_checks import check_cameras
from predmapnet.datasets.poses import pose_matrix
from predmapnet.datasets.undistortion import BROWN_CONRADY, COEFFICIENTS, KANNALA_BRANDT, undistorted_camera
from predmapnet.errors import UserError
from predmapnet.files import file_name, write_file
from predmapnet.scenes import Camera, Rig

CALIBRATION = "calibration.json"

HALF_A_PIXEL = 0.5
"""From OpenCV's principal point (centre of the first pixel at 0) to ours (at 0.5)."""

MODELS = {
    **dict.fromkeys(("pinhole", "plumb_bob", "radtan", "brown_conrady", "rational_polynomial"), BROWN_CONRADY),
    **dict.fromkeys(("fisheye", "equidistant", "kannala_brandt"), KANNALA_BRANDT),
}
"""Names of camera models, and the lens that each stands for."""

HIGHEST_ORIGIN = 10.0
"""Metres of a car's frame above the road, or below it."""

MOST_CAMERAS = 8
"""Cameras that the shipped network has learned to look through at once."""


@dataclass(frozen=True)
class LogCalibration:
    """Content of ``calibration.json``.

    Attributes:
        rig: the cameras, undistorted.
        poses_of: ``(4, 4)`` ``camera_to_ego`` of the camera that the poses of the log are of; None if of the car.
    """

    rig: Rig
    poses_of: Float | None


def read_calibration(path: Path) -> LogCalibration:
    """Read ``calibration.json``.

    Raises:
        UserError: the file is missing or damaged, describes no camera or more than 8, or says what no car has.
    """
    if not path.is_file():
        raise UserError(f"There is no {path}: it describes the cameras of the log (docs/own-logs.md).")
    content = parse_json(path.read_bytes(), path, unique=True)
    cameras = content.get("cameras") if isinstance(content, dict) else None
    if not isinstance(cameras, dict) or not cameras or not all(isinstance(entry, dict) for entry in cameras.values()):
        raise UserError(f"{path}: an object 'cameras' is expected, which describes each camera by name.")
    if len(cameras) > MOST_CAMERAS:
        raise UserError(
            f"{path} describes {len(cameras)} cameras ({', '.join(cameras)}), but the network has learned to look "
            f"through at most {MOST_CAMERAS} at once. Delete those from the file that see what others see; their "
            "images may stay."
        )
    ground_height = -_number(content, "ego_origin_above_road_m", str(path))
    if abs(ground_height) > HIGHEST_ORIGIN:
        raise UserError(
            f"{path}: the ego origin would be {-ground_height:,.0f} m above the road: is that in millimetres, or a "
            "height above the sea?"
        )
    rig = tuple(_camera(name, entry, ground_height, f"{path}, {name}") for name, entry in cameras.items())
    check_cameras([entry["camera_to_ego"]["rotation_wxyz"] for entry in cameras.values()], str(path))
    of = content.get("poses_of")
    if of is not None and of not in cameras:
        raise UserError(f"{path}: 'poses_of' must be one of the cameras ({', '.join(cameras)}), not {of!r}.")
    return LogCalibration(rig, None if of is None else _mounting(cameras[of], f"{path}, {of}"))


def _camera(name: str, entry: Mapping[str, Any], ground_height: float, where: str) -> Camera:
    if file_name(name) != name:
        raise UserError(f"{where}: the name of a camera is that of the folder of its images, and cannot be {name!r}.")
    width, height = whole_field(entry, "width", where), whole_field(entry, "height", where)
    stated = _object(entry, "intrinsics", where)
    fx, fy, cx, cy = (_number(stated, key, f"{where}, intrinsics") for key in ("fx", "fy", "cx", "cy"))
    intrinsics = np.array([[fx, 0.0, cx + HALF_A_PIXEL], [0.0, fy, cy + HALF_A_PIXEL], [0.0, 0.0, 1.0]])
    check_principal_point(intrinsics, width, height, where)
    camera = Camera(name, width, height, intrinsics, _mounting(entry, where), ground_height)
    model, distortion = _lens(entry, where)
    return camera if distortion is None else undistorted_camera(camera, model, distortion, where)


def _mounting(entry: Mapping[str, Any], where: str) -> Float:
    mounting, where = _object(entry, "camera_to_ego", where), f"{where}, camera_to_ego"
    rotation, translation = (
        numbers_field(mounting, name, (size,), where) for name, size in (("rotation_wxyz", 4), ("translation_m", 3))
    )
    camera_to_ego = pose_matrix(rotation.tolist(), translation.tolist(), where)
    check_mounting(camera_to_ego, where)
    return camera_to_ego


def _object(entry: Mapping[str, Any], name: str, where: str) -> Mapping[str, Any]:
    found = entry.get(name)
    if not isinstance(found, dict):
        raise UserError(f"{where}: an object '{name}' is expected.")
    return found


def _lens(entry: Mapping[str, Any], where: str) -> tuple[str, Float | None]:
    """Return the model and the coefficients of a camera's lens; None of a camera without distortion."""
    stated = text_field(entry, "model", where)
    model = MODELS.get(stated.lower().replace("-", "_"))
    if model is None:
        raise UserError(f"{where}: the camera model {stated!r} is not known; there are: {', '.join(MODELS)}.")
    values = entry.get("distortion") or []
    count = len(values) if isinstance(values, list) else 0
    if count == 0 and model == BROWN_CONRADY and values == []:
        return model, None
    if count not in COEFFICIENTS[model]:
        expected = " or ".join(map(str, COEFFICIENTS[model]))
        raise UserError(f"{where}: 'distortion' of the model {stated} must be a list of {expected} numbers.")
    distortion = numbers_field(entry, "distortion", (count,), where)
    return model, distortion if model == KANNALA_BRANDT or distortion.any() else None


def _number(record: Mapping[str, Any], name: str, where: str) -> float:
    return float(numbers_field(record, name, (), where))


def write_rig(path: Path, rig: Rig) -> None:
    """Write ``calibration.json`` of pinhole cameras; raises UserError if that fails."""
    cameras = {}
    for camera in rig:
        x, y, z, w = Rotation.from_matrix(camera.camera_to_ego[:3, :3]).as_quat(canonical=True).tolist()
        k = camera.intrinsics
        cameras[camera.name] = {
            "width": camera.width,
            "height": camera.height,
            "model": "pinhole",
            "intrinsics": {"fx": k[0, 0], "fy": k[1, 1], "cx": k[0, 2] - HALF_A_PIXEL, "cy": k[1, 2] - HALF_A_PIXEL},
            "camera_to_ego": {"translation_m": camera.camera_to_ego[:3, 3].tolist(), "rotation_wxyz": [w, x, y, z]},
        }
    write_calibration(path, cameras, -rig[0].ground_height if rig else 0.0)


def write_calibration(path: Path, cameras: Mapping[str, Mapping[str, Any]], height: float) -> None:
    """Write ``calibration.json``.

    Args:
        path: of the file.
        cameras: entries by name, as the file has them.
        height: of the ego origin above the road, metres.

    Raises:
        UserError: it cannot be written.
    """
    with write_file(path) as draft:
        draft.write_text(json.dumps({"ego_origin_above_road_m": height, "cameras": cameras}, indent=1))
