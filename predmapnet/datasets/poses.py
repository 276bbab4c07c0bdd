"""Poses as data sets store them: unit quaternions and translations, checked before they are believed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from predmapnet.errors import UserError

Float = NDArray[np.float64]
QUATERNION_TOLERANCE = 1e-3


def rotation_matrix(quaternion: Float) -> Float:
    """Rotation matrices of unit quaternions.

    Args:
        quaternion: ``(..., 4)``, order w, x, y, z; normalised here.

    Returns:
        ``(..., 3, 3) float64``.
    """
    w, x, y, z = np.moveaxis(quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def pose_matrix(rotation_wxyz: Sequence[float], translation: Sequence[float], where: str) -> Float:
    """Build a pose from what a file says.

    Args:
        rotation_wxyz: unit quaternion w, x, y, z.
        translation: x, y, z in metres.
        where: scene, frame and file, for the message.

    Returns:
        ``(4, 4) float64``.

    Raises:
        UserError: a value is missing, not finite, or the quaternion is not a rotation.
    """
    try:
        quaternion = np.array(rotation_wxyz, dtype=np.float64).reshape(4)
        offset = np.array(translation, dtype=np.float64).reshape(3)
    except (TypeError, ValueError):
        raise UserError(
            f"{where}: a pose needs a rotation of 4 numbers and a translation of 3, "
            f"but has rotation {rotation_wxyz} and translation {translation}."
        ) from None
    norm = float(np.linalg.norm(quaternion))
    if not (np.isfinite(offset).all() and np.isfinite(norm) and abs(norm - 1.0) <= QUATERNION_TOLERANCE):
        raise UserError(
            f"{where}: the pose is not a rigid motion: rotation (w, x, y, z) {quaternion.tolist()} of length "
            f"{norm:.6g} (must be 1), translation {offset.tolist()} m (must be finite). Repair or remove this frame."
        )
    pose = np.eye(4)
    pose[:3, :3] = rotation_matrix(quaternion)
    pose[:3, 3] = offset
    return pose
