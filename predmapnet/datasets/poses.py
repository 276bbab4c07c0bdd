"""Poses as data sets store them: unit quaternions and translations, with checks."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mapfusion.arrays import Float
from mapfusion.geometry import FARTHEST_POSE, rotation_of_quaternion
from predmapnet.datasets.fields import numbers
from predmapnet.errors import UserError

QUATERNION_TOLERANCE = 1e-3


def quaternion_of(rotation: Float) -> Float:
    """Unit quaternion ``(4,)`` (w, x, y, z) of a rotation matrix ``(3, 3)``, signed as by the official reader."""
    ((a, b, c), (d, e, f), (g, h, i)) = rotation.tolist()
    if i < 0:
        if a > e:
            square = 1 + a - e - i
            parts = (h - f, square, d + b, c + g)
        else:
            square = 1 - a + e - i
            parts = (c - g, d + b, square, h + f)
    elif a < -e:
        square = 1 - a - e + i
        parts = (d - b, c + g, h + f, square)
    else:
        square = 1 + a + e + i
        parts = (square, h - f, c - g, d - b)
    return np.array(parts) * (0.5 / math.sqrt(square))


def combined(outer: Float, inner: Float) -> Float:
    """``outer @ inner`` of two poses ``(4, 4)``, with the same bits on every machine."""
    terms = outer[:, :, None] * inner[None, :, :]
    return np.asarray(((terms[:, 0] + terms[:, 1]) + terms[:, 2]) + terms[:, 3])


def pose_matrix(rotation_wxyz: Sequence[float], translation: Sequence[float], where: str) -> Float:
    """Build a pose ``(4, 4) float64`` from a quaternion w, x, y, z and a translation, metres.

    Raises UserError, naming ``where``, for values that are missing or not finite, and for no rotation.
    """
    try:
        quaternion, offset = numbers(rotation_wxyz).reshape(4), numbers(translation).reshape(3)
    except ValueError:
        raise UserError(
            f"{where}: a pose needs a rotation of 4 numbers and a translation of 3, "
            f"but has rotation {rotation_wxyz} and translation {translation}."
        ) from None
    norm = float(np.linalg.norm(quaternion))
    if not (np.abs(offset) <= FARTHEST_POSE).all() or not abs(norm - 1.0) <= QUATERNION_TOLERANCE:
        raise UserError(
            f"{where}: the pose is not a rigid motion: rotation (w, x, y, z) {quaternion.tolist()} of length "
            f"{norm:.6g} (must be 1), translation {offset.tolist()} m (must be finite, and "
            f"at most {FARTHEST_POSE:g}). Repair or remove this frame."
        )
    pose = np.eye(4)
    pose[:3, :3] = rotation_of_quaternion(quaternion)
    pose[:3, 3] = offset
    return pose
