"""Correction of the poses of single frames by what the frames of a drive show together.

Every frame is one noisy copy of the same lines. In rounds, each is moved to where the others have them on average
(mean shift: the average counts what lies near, and ever nearer), as far as its own pose may be wrong. What no frame
shows, such as the place along a straight road, stays as it was measured; so does the mean of the drive.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from mapfusion.arrays import Float, Integer
from mapfusion.elements import ElementKind, FrameMap
from mapfusion.geometry import rigid_pose_problem
from mapfusion.stretches import sample_lines

SPACING = 2.0
"""Distance between the samples of a line, metres."""

NEIGHBOURS = 32
"""Number of samples looked at around each, those of the same frame among them."""

SCALES = (1.5, 1.2, 1.0, 0.8, 0.6, 0.5, 0.4, 0.4)
"""Standard deviation of what counts as near, one per round, metres."""

DEVIATION = 0.3
"""Of a detection across its line, metres."""

CORRELATION = 10.0
"""Detections of this length of line err alike and count as one, metres."""


@dataclass(frozen=True)
class PoseErrors:
    """Standard deviations of the errors of poses, each frame's by themselves.

    Attributes:
        along, sideways: metres, in the direction of the car and across it.
        turn: radians.
    """

    along: float = 1.5
    sideways: float = 0.75
    turn: float = np.radians(0.85)


@dataclass(frozen=True)
class _Samples:
    """Samples of the lines of all frames, ego frame, as arrays of equal length."""

    points: Float
    tangents: Float
    frame: Integer
    kind: Integer


def correct_poses(frames: Sequence[FrameMap], errors: PoseErrors | None = None) -> list[FrameMap]:
    """Return the frames of one drive with corrected poses.

    Args:
        frames: of one drive, in any order; their tracked elements count. A frame with a broken pose stays as it is.
        errors: how far poses may be off.
    """
    errors = errors or PoseErrors()
    samples = _sampled(frames)
    corrections = np.zeros((len(frames), 3))
    poses = np.array([frame.ego_to_global if _sound(frame) else np.eye(4) for frame in frames]).reshape(-1, 4, 4)
    if len(samples.frame):
        prior = np.array([errors.along, errors.sideways, errors.turn]) ** -2.0
        for scale in SCALES:
            corrections = _round(samples, poses, corrections, prior, scale)
    motions = _motions(corrections)
    return [
        replace(frame, ego_to_global=frame.ego_to_global @ motion) if _sound(frame) else frame
        for frame, motion in zip(frames, motions, strict=True)
    ]


def _sound(frame: FrameMap) -> bool:
    return rigid_pose_problem(frame.ego_to_global) is None


def _sampled(frames: Sequence[FrameMap]) -> _Samples:
    lines, kinds, owners = [], [], []
    for number, frame in enumerate(frames):
        tracked = frame.tracked
        for kind, points in zip(tracked.kinds, tracked.polylines, strict=True):
            if len(points) >= 2 and np.isfinite(points).all() and _sound(frame):
                # the two sides of a crossing are told apart by the way they run
                clockwise = (points[:-1, 0] * points[1:, 1] - points[1:, 0] * points[:-1, 1]).sum() < 0.0
                lines.append(points[::-1] if ElementKind(int(kind)).is_ring and clockwise else points)
                kinds.append(int(kind))
                owners.append(number)
    samples = sample_lines(lines, SPACING)
    frame_of, kind_of = np.array(owners, dtype=np.int64), np.array(kinds, dtype=np.int64)
    return _Samples(samples.points, samples.tangents, frame_of[samples.line], kind_of[samples.line])


def _round(samples: _Samples, poses: Float, corrections: Float, prior: Float, scale: float) -> Float:
    """Return corrections ``(n, 3)`` (along, sideways, turn) after one round."""
    placed = (poses @ _motions(corrections))[samples.frame]
    points = (placed[:, :2, :2] @ samples.points[:, :, None])[..., 0] + placed[:, :2, 3]
    tangents = (placed[:, :2, :2] @ samples.tangents[:, :, None])[..., 0]
    pull, weight = np.zeros(len(points)), np.zeros(len(points))
    for kind in ElementKind:
        rows = np.flatnonzero(samples.kind == kind)
        if len(rows):
            pull[rows], weight[rows] = _pulls(points[rows], tangents[rows], samples.frame[rows], kind, scale)
    # how far a step of the car (along, sideways, turn) moves a sample across its line
    across = np.stack([-samples.tangents[:, 1], samples.tangents[:, 0]], axis=1)
    lever = (samples.points * samples.tangents).sum(axis=1)
    design = np.column_stack([across, lever])
    # as long as it is wide, the average of the others is itself unsure
    weight *= SPACING / CORRELATION / (DEVIATION**2 + scale**2 / 4)
    matrices, rights = np.tile(np.diag(prior), (len(poses), 1, 1)), -prior * corrections
    np.add.at(matrices, samples.frame, weight[:, None, None] * design[:, :, None] * design[:, None, :])
    np.add.at(rights, samples.frame, (weight * pull)[:, None] * design)
    return np.asarray(corrections + np.linalg.solve(matrices, rights[..., None])[..., 0])


def _pulls(points: Float, tangents: Float, frame: Integer, kind: ElementKind, scale: float) -> tuple[Float, Float]:
    """Return how far across its line each sample lies from where other frames have it, and how sure that is, 0 to 1."""
    count = min(NEIGHBOURS, len(points))
    distance, near = cKDTree(points).query(points, k=count, distance_upper_bound=2.5 * scale + SPACING / 2)
    distance, near = distance.reshape(-1, count), np.minimum(near, len(points) - 1).reshape(-1, count)
    gap = points[near] - points[:, None]
    same = (tangents[near] * tangents[:, None]).sum(axis=2)
    normal = np.stack([-tangents[:, 1], tangents[:, 0]], axis=1)
    across, along = (gap * normal[:, None]).sum(axis=2), (gap * tangents[:, None]).sum(axis=2)
    usable = np.isfinite(distance) & (frame[near] != frame[:, None]) & (np.abs(along) < SPACING)
    usable &= (same if kind.is_ring else np.abs(same)) > np.cos(np.radians(30.0))
    near_by = np.where(usable, np.exp(-0.5 * (across / scale) ** 2), 0.0)
    total = near_by.sum(axis=1)
    return (near_by * across).sum(axis=1) / np.maximum(total, 1e-9), total / (total + 1.0)


def _motions(corrections: Float) -> Float:
    """Return the motions ``(n, 4, 4)`` of corrections, in the frame of the car."""
    motions = np.tile(np.eye(4), (len(corrections), 1, 1))
    cosine, sine = np.cos(corrections[:, 2]), np.sin(corrections[:, 2])
    motions[:, :2, :2] = np.stack([cosine, -sine, sine, cosine], axis=1).reshape(-1, 2, 2)
    motions[:, :2, 3] = corrections[:, :2]
    return motions
