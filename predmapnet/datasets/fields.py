"""Fields of foreign records, checked: what a file lacks or holds in another form is told with file, place and field."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mapfusion.arrays import Float
from predmapnet.errors import UserError

FARTHEST_CAMERA = 100.0
"""Metres from the ego origin."""
EXACT = 2**53
"""Whole numbers below are exact whatever number they are stored as."""


def text_field(record: Mapping[str, Any], name: str, where: str) -> str:
    """Return a field that is a text. Raises UserError if it is missing or something else."""
    value = record.get(name)
    if not isinstance(value, str):
        raise _wrong(record, name, "a text", where)
    return value


def whole_field(record: Mapping[str, Any], name: str, where: str) -> int:
    """Return a field that is an integer from 0 on. Raises UserError if it is missing, too large or something else."""
    value = record.get(name)
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)) or value != value // 1:
        raise _wrong(record, name, "a whole number", where)
    if not 0 <= value < 2**63:
        raise _wrong(record, name, "a whole number from 0 on, of 63 bits at most,", where)
    return int(value)


def numbers_field(record: Mapping[str, Any], name: str, shape: tuple[int, ...], where: str) -> Float:
    """Return a field that holds finite numbers of a shape. Raises UserError if it is missing or something else."""
    try:
        found = numbers(record.get(name))
    except ValueError:
        found = np.zeros(0)
    if found.shape != shape or not np.isfinite(found).all():
        expected = " x ".join(map(str, shape)) + " finite numbers" if shape else "a finite number"
        raise _wrong(record, name, expected, where)
    return found


def numbers(value: Any) -> Float:
    """Return the numbers of a list, or of lists of equal length. Raises ValueError for everything else."""
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, OverflowError) as error:
        raise ValueError(str(error)) from None


def _wrong(record: Mapping[str, Any], name: str, expected: str, where: str) -> UserError:
    found = f"is {str(record[name])[:60]!r}" if record.get(name) is not None else "is missing"
    token = record.get("token")
    which = f", record {str(token)[:60]}" if token is not None else ""
    return UserError(f"{where}{which}: the field '{name}' {found}; {expected} is expected.")


def is_given(path: Path) -> bool:
    """Whether something has the name of a file that need not be there: a folder or a broken link is no lack of it."""
    return path.exists() or path.is_symlink()


def is_there(path: Path) -> bool:
    """Whether a file that a table names exists; a name that no disk can hold is that of none."""
    try:
        return path.is_file()
    except OSError:
        return False


def check_mounting(camera_to_ego: Float, where: str) -> None:
    """Raise UserError for a camera that no car carries, metres away: its translation is in another unit."""
    away = float(np.linalg.norm(camera_to_ego[:3, 3]))
    if away > FARTHEST_CAMERA:
        raise UserError(f"{where}: the camera would be {away:,.0f} m from the ego origin: is that in millimetres?")


def check_principal_point(intrinsics: Float, width: int, height: int, where: str) -> None:
    """Raise UserError if a camera's principal point lies outside of its image: they are of different sizes."""
    x, y = float(intrinsics[0, 2]), float(intrinsics[1, 2])
    if not (0.0 < x < width and 0.0 < y < height) or not (intrinsics[[0, 1], [0, 1]] > 0.0).all():
        raise UserError(
            f"{where}: the intrinsics (focal lengths {intrinsics[0, 0]:g} and {intrinsics[1, 1]:g}, principal point "
            f"{x:g}, {y:g}) are not those of images of {width} x {height} pixels. Were the images scaled?"
        )
    if not 0.25 < intrinsics[0, 0] / intrinsics[1, 1] < 4.0:
        raise UserError(
            f"{where}: the focal lengths {intrinsics[0, 0]:g} and {intrinsics[1, 1]:g} differ as those of no camera."
        )
