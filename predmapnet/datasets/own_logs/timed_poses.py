"""Poses of a drive at instants of their own, and between them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mapfusion.arrays import Bool, Float, Integer
from predmapnet.files import write_file

LONGEST_GAP = 1_000_000_000
"""Poses farther apart say nothing about the way between them, nanoseconds."""
FARTHEST_BEYOND = 100_000_000
"""Time by which a drive is carried on before its first and after its last pose, nanoseconds."""


@dataclass(frozen=True)
class TimedPoses:
    """Poses of one drive.

    Attributes:
        timestamps: ``(n,) int64``, ascending, nanoseconds.
        ego_to_global: ``(n, 4, 4) float64``.
    """

    timestamps: Integer
    ego_to_global: Float

    def at(self, timestamp: int) -> Float:
        """Return the pose ``(4, 4)`` at any instant: a straight line and a steady turn between neighbours.

        Beyond the first and the last pose, the motion goes on for a tenth of a second and then stands still.
        """
        if len(self.timestamps) == 1:
            return np.array(self.ego_to_global[0])
        first, last = int(self.timestamps[0]), int(self.timestamps[-1])
        instant = min(max(timestamp, first - FARTHEST_BEYOND), last + FARTHEST_BEYOND)
        row = min(max(int(np.searchsorted(self.timestamps, instant, side="right")) - 1, 0), len(self.timestamps) - 2)
        start, stop = self.timestamps[row : row + 2].tolist()
        share = (instant - start) / (stop - start)
        before, after = self.ego_to_global[row], self.ego_to_global[row + 1]
        turn = Rotation.from_matrix(before[:3, :3].T @ after[:3, :3]).as_rotvec()
        pose = np.array(before)
        pose[:3, :3] = before[:3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
        pose[:3, 3] += share * (after[:3, 3] - before[:3, 3])
        return pose

    def cover(self, timestamps: Integer) -> Bool:
        """Tell of instants whether the drive is known there: not in a long gap, not far before or after the poses."""
        first, last = self.timestamps[[0, -1]]
        inside = (timestamps >= first - FARTHEST_BEYOND) & (timestamps <= last + FARTHEST_BEYOND)
        if len(self.timestamps) == 1:
            return np.asarray(inside)
        after = np.searchsorted(self.timestamps, timestamps, side="right").clip(1, len(self.timestamps) - 1)
        return np.asarray(inside & (self.timestamps[after] - self.timestamps[after - 1] <= LONGEST_GAP))


def rows_apart(positions: Float, metres: float) -> Integer:
    """Return rows of positions ``(n, d)`` along a way that are about so many metres apart, the first one among them."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])
    return np.flatnonzero(np.diff(np.floor(way / metres), prepend=-1.0) > 0)


def write_timed_poses(path: Path, poses: TimedPoses) -> None:
    """Write ``poses.csv``; raises UserError if that fails."""
    with write_file(path) as draft:
        draft.write_text("\n".join(["timestamp_ns,x,y,z,qw,qx,qy,qz", *_lines(poses)]) + "\n")


def _lines(poses: TimedPoses) -> Iterable[str]:
    for timestamp, pose in zip(poses.timestamps.tolist(), poses.ego_to_global, strict=True):
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True)
        yield f"{timestamp}," + ",".join(f"{value:.10f}" for value in (*pose[:3, 3], w, x, y, z))
