"""How good a fused map is, against the true one: the figures of the comparison table."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mapfusion.elements import ElementKind, GlobalMap
from mapfusion.geometry import arc_length, inverse_pose, resample, transform_points

from tests.mapfusion.simulation import ROI, Drive, Ghost

Float = NDArray[np.float64]
STEP = 0.25
FAR = 1e6


@dataclass(frozen=True)
class Quality:
    """Figures of one map; lengths in metres."""

    precision: float
    recall: float
    lateral: float
    elements_per_true: float
    ghosts_alive: int


def dense(points: Float) -> Float:
    """Return points every quarter metre."""
    return resample(points, max(int(arc_length(points)[-1] / STEP), 1) + 1)


def looked_at(points: Float, drive: Drive, rim: float = 1.5) -> NDArray[np.int64]:
    """Return in how many frames each point lay in the ROI, clear of its rim."""
    count = np.zeros(len(points), dtype=np.int64)
    for frame in drive.frames:
        local = np.abs(transform_points(inverse_pose(frame.ego_to_global), points))
        count += (local < ROI.size / 2 - rim).all(axis=1)
    return count


def measure(fused: GlobalMap, drive: Drive, within: float = 0.5, least_views: int = 3) -> Quality:
    """Compare a map with the truth, as far as the drive has looked at it in ``least_views`` frames."""
    hit = length = found = true_length = 0
    errors = []
    true_elements = 0
    for kind in ElementKind:
        truth = [dense(e.points) for e in drive.truth.of_kind(kind)]
        everything = cKDTree(np.concatenate(truth) if truth else np.full((1, 2), FAR))
        seen = []
        for points in truth:
            visible = looked_at(points, drive) >= least_views
            seen.append(points[visible])
            if visible.sum() * STEP > 2.0:
                # a ring, or a closed line, whose start lies inside is still one piece
                starts = int(np.diff(np.concatenate([[0], visible.astype(int)])).clip(0).sum())
                closed = np.linalg.norm(points[0] - points[-1]) < 0.5 and bool(visible[0] and visible[-1])
                true_elements += max(starts - closed, 1)
        lines = [dense(e.points) for e in fused.of_kind(kind)]
        if lines:
            distance = everything.query(np.concatenate(lines))[0]
            hit += int((distance < within).sum())
            length += len(distance)
            errors.append(distance[distance < 1.5])
        wanted = np.concatenate(seen) if seen else np.zeros((0, 2))
        tree = cKDTree(np.concatenate(lines) if lines else np.full((1, 2), FAR))
        found += int((tree.query(wanted)[0] < within).sum()) if len(wanted) else 0
        true_length += len(wanted)
    return Quality(
        precision=hit / max(length, 1),
        recall=found / max(true_length, 1),
        lateral=float(np.median(np.concatenate(errors))) if errors else np.nan,
        elements_per_true=len(fused) / max(true_elements, 1),
        ghosts_alive=sum(ghost_alive(ghost, fused, drive) for ghost in drive.ghosts),
    )


def ghost_alive(ghost: Ghost, fused: GlobalMap, drive: Drive) -> bool:
    """Whether a ghost that was reported in fewer than 3 of 10 frames in view is in the map."""
    points = dense(ghost.points)
    views = float(np.median(looked_at(points, drive)))
    if views == 0 or len(ghost.frames) >= 0.3 * views:
        return False
    others = [dense(e.points) for e in drive.truth.of_kind(ghost.kind)]
    if others:
        points = points[cKDTree(np.concatenate(others)).query(points)[0] > 2.0]
    lines = [dense(e.points) for e in fused.of_kind(ghost.kind)]
    if not len(points) or not lines:
        return False
    return bool((cKDTree(np.concatenate(lines)).query(points)[0] < 1.0).mean() > 0.5)


def faults(fused: GlobalMap) -> list[str]:
    """Name lines that cross themselves, rings that are invalid, and spikes (turns of more than 120 degrees)."""
    found = []
    for number, e in enumerate(fused):
        shape = shapely.Polygon(e.points) if e.kind.is_ring else shapely.LineString(e.points)
        if not (shape.is_valid and (e.kind.is_ring or shape.is_simple)):
            found.append(f"{number}: {e.kind.label} crosses itself")
        step = np.diff(e.points, axis=0)
        step /= np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-9)
        if ((step[1:] * step[:-1]).sum(axis=1) < -0.5).any():
            found.append(f"{number}: {e.kind.label} has a spike")
    return found
