"""Quality of a fused map against the true one: the figures of the comparison table."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import shapely
from numpy.typing import NDArray

from mapfusion.arrays import Float
from mapfusion.elements import ElementKind, GlobalMap
from mapfusion.geometry import arc_length, inverse_pose, resample, transform_points
from tests.mapfusion.simulation import ROI, Drive, Ghost

if TYPE_CHECKING:
    from tests.mapfusion.demo_towns import MappedTown

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


def nearest(points: Float, lines: list[Float]) -> Float:
    """Return the distance of each point to the nearest of the lines, metres; far where there are none."""
    if not lines or not len(points):
        return np.full(len(points), FAR)
    tree = shapely.STRtree(shapely.segmentize([shapely.LineString(line) for line in lines], 5.0))
    (row, _), distance = tree.query_nearest(shapely.points(points), return_distance=True, all_matches=False)
    result = np.full(len(points), FAR)
    result[row] = distance
    return result


def dense(points: Float) -> Float:
    """Return points every quarter metre."""
    return resample(points, max(int(arc_length(points)[-1] / STEP), 1) + 1)


def looked_at(points: Float, drive: Drive | MappedTown, rim: float = 1.5) -> NDArray[np.int64]:
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
        seen = []
        for points in truth:
            visible = looked_at(points, drive) >= least_views
            seen.append(points[visible])
            if visible.sum() * STEP > 2.0:
                # a ring, or a closed line, whose start lies inside is still one piece
                starts = int(np.diff(np.concatenate([[0], visible.astype(int)])).clip(0).sum())
                closed = np.linalg.norm(points[0] - points[-1]) < 0.5 and bool(visible[0] and visible[-1])
                true_elements += max(starts - int(closed), 1)
        lines = [dense(e.points) for e in fused.of_kind(kind)]
        if lines:
            distance = nearest(np.concatenate(lines), truth)
            hit += int((distance < within).sum())
            length += len(distance)
            errors.append(distance[distance < 1.5])
        wanted = np.concatenate(seen) if seen else np.zeros((0, 2))
        found += int((nearest(wanted, lines) < within).sum())
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
        points = points[nearest(points, others) > 2.0]
    lines = [dense(e.points) for e in fused.of_kind(ghost.kind)]
    if not len(points) or not lines:
        return False
    return bool((nearest(points, lines) < 1.0).mean() > 0.5)


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
