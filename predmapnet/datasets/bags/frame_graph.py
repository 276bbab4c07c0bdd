"""Frames of a bag and the transforms between them, as ``/tf``, ``/tf_static`` and odometry say them."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from mapfusion.arrays import Float, Integer
from mapfusion.geometry import inverse_pose
from predmapnet.datasets.own_logs.timed_poses import TimedPoses
from predmapnet.datasets.poses import QUATERNION_TOLERANCE
from predmapnet.errors import UserError

STILL_METRES, STILL_RADIANS = 0.02, 0.01
"""A transform that changes by no more is a mounting, not a motion."""

Link = tuple[str, str]
"""Names of the parent and the child frame."""


class FrameGraph:
    """Transforms ``child_to_parent`` at instants, by their frames.

    A frame may have several parents, as it happens where two programs say where the car is.
    """

    def __init__(self) -> None:
        self._rows: dict[Link, dict[int, tuple[float, ...]]] = {}
        self._links: dict[Link, TimedPoses] = {}
        self.wrong = 0
        """Transforms that are no rigid motion."""

    def add(self, parent: str, child: str, timestamp: int, pose: tuple[float, ...]) -> None:
        """Add a transform: x, y, z in metres and the quaternion x, y, z, w."""
        self._links.clear()
        numbers = np.array(pose)
        if np.isfinite(numbers).all() and abs(float(np.linalg.norm(numbers[3:])) - 1.0) <= QUATERNION_TOLERANCE:
            self._rows.setdefault((parent.strip("/"), child.strip("/")), {})[timestamp] = pose
        else:
            self.wrong += 1

    @property
    def links(self) -> dict[Link, TimedPoses]:
        """Transforms of each link in the order of time."""
        if not self._links:
            self._links = {link: _timed(rows) for link, rows in self._rows.items()}
        return self._links

    @property
    def frames(self) -> list[str]:
        """Names of all frames, sorted."""
        return sorted({frame for link in self._rows for frame in link})

    def mounting(self, child: str, parent: str) -> Float:
        """Return ``child_to_parent`` ``(4, 4)`` of two frames that do not move against each other.

        Raises:
            UserError: no transforms lead from one to the other, or they move.
        """
        path = self.path(child, parent, {link for link, poses in self.links.items() if is_still(poses)})
        if path is None:
            if self.path(child, parent) is None:
                raise UserError(f"no transform leads from {child} to {parent}")
            raise UserError(f"{child} moves against {parent}, and a camera must be fixed to the car")
        pose = np.eye(4)
        for step in pairwise(path):
            link, forward = (step[::-1], True) if step[::-1] in self.links else (step, False)
            found = self.links[link].ego_to_global[-1]
            pose = (found if forward else inverse_pose(found)) @ pose
        return pose

    def drive(self, child: str, parent: str) -> TimedPoses | None:
        """Return ``child_to_parent`` while all transforms between them are known; None if they are not linked."""
        path = self.path(child, parent)
        if path is None:
            return None
        steps = [step[::-1] if step[::-1] in self.links else step for step in pairwise(path)]
        moving = [self.links[link] for link in steps if not is_still(self.links[link])]
        if not moving:
            return None
        finest = max(moving, key=lambda poses: len(poses.timestamps)).timestamps
        first, last = max(poses.timestamps[0] for poses in moving), min(poses.timestamps[-1] for poses in moving)
        times = finest[(finest >= first) & (finest <= last)]
        if not len(times):
            return None
        result = np.tile(np.eye(4), (len(times), 1, 1))
        for link, step in zip(steps, pairwise(path), strict=True):
            poses = _sampled(self.links[link], times)
            result = (poses if link == step[::-1] else np.array([inverse_pose(pose) for pose in poses])) @ result
        return TimedPoses(times, result)

    def path(self, start: str, goal: str, links: set[Link] | None = None) -> list[str] | None:
        """Return the frames of the shortest way between two frames, over some links or all; None if there is none."""
        usable = self._rows.keys() if links is None else links
        neighbours: dict[str, list[str]] = {}
        for parent, child in usable:
            neighbours.setdefault(parent, []).append(child)
            neighbours.setdefault(child, []).append(parent)
        ways, waiting = {start: [start]}, [start]
        for frame in waiting:
            for following in neighbours.get(frame, []):
                if following not in ways:
                    ways[following] = [*ways[frame], following]
                    waiting.append(following)
        return ways.get(goal)


def is_still(poses: TimedPoses) -> bool:
    """Tell whether a transform stays what it was first."""
    first = poses.ego_to_global[0]
    moved = np.abs(poses.ego_to_global[:, :3, 3] - first[:3, 3]).max()
    turned = np.abs(poses.ego_to_global[:, :3, :3] - first[:3, :3]).max()
    return bool(moved <= STILL_METRES and turned <= STILL_RADIANS)


def _timed(rows: dict[int, tuple[float, ...]]) -> TimedPoses:
    order = sorted(rows)
    numbers = np.array([rows[timestamp] for timestamp in order])
    poses = np.tile(np.eye(4), (len(order), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(numbers[:, 3:]).as_matrix()
    poses[:, :3, 3] = numbers[:, :3]
    return TimedPoses(np.array(order, dtype=np.int64), poses)


def _sampled(poses: TimedPoses, times: Integer) -> Float:
    """Return poses ``(n, 4, 4)`` at instants, as :meth:`TimedPoses.at` does one by one; ends are held."""
    if len(poses.timestamps) == 1:
        return np.tile(poses.ego_to_global[0], (len(times), 1, 1))
    start = poses.timestamps[0]
    known = (poses.timestamps - start) / 1e9
    wanted = ((times - start) / 1e9).clip(known[0], known[-1])
    result = np.tile(np.eye(4), (len(times), 1, 1))
    result[:, :3, :3] = Slerp(known, Rotation.from_matrix(poses.ego_to_global[:, :3, :3]))(wanted).as_matrix()
    for axis in range(3):
        result[:, axis, 3] = np.interp(wanted, known, poses.ego_to_global[:, axis, 3])
    return result
