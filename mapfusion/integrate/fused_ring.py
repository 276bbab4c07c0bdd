"""Crossing of the map as a grid of averaged signed distances to its observed rings."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import shapely
from numpy.typing import NDArray

from mapfusion.arrays import Bool, Float, Integer, Marks
from mapfusion.elements import ElementKind, RegionOfInterest
from mapfusion.geometry import inverse_pose, transform_points
from mapfusion.integrate.evidence import Evidence
from mapfusion.integrate.observations import Observation
from mapfusion.signed_distance import TRUNCATION, positive_areas, signed_distance

Grid = NDArray[np.float32]
Window = tuple[slice, slice]

BESIDE = 0.5
"""Half width of the band of cells about the outline in which scatter is measured, metres."""

LOOSE_TOLERANCE = 1.5
"""Tolerance of the outline where a crossing goes on unseen, cells."""

CUT_RIM = 0.75
"""Edges of a ring this close to the rim of the ROI were cut by it and do not count, metres."""


@dataclass
class FusedRing:
    """Crossing of the map, as sums over its observations per cell of a lattice common to the whole map.

    Truncated signed distances are averaged cell by cell (Curless and Levoy, SIGGRAPH 1996) and the fused outline is
    where their mean is zero. The sums do not depend on the order of observations, nor on where a ring starts or
    which way it runs; cells that an observation could not see count neither way, so an end that the ROI has cut is
    not an end.

    Attributes:
        corner: ``(2,) int64``, lattice index of the first cell.
        distance: ``(rows, columns) float32``, sum of information times signed distance, positive inside, 1 / m.
        looked: sum of information of the observations that could see the cell, 1 / m².
        seen_view: sum of the view weights of the observations.
        seen: sum of sightings, weighted by score.
        evidence: times, tracks and counts.
        scatter: sum of the observations' squared distances from the outline, times information.
        marks: ``(2,) uint64``, bits for the places from which it was seen and for the tracks.
    """

    corner: Integer
    distance: Grid
    looked: Grid
    seen_view: Grid
    seen: float
    evidence: Evidence
    scatter: float = 0.0
    marks: Marks = field(default_factory=lambda: np.zeros(2, dtype=np.uint64))
    kind: ElementKind = ElementKind.PED_CROSSING

    @property
    def stop(self) -> Integer:
        """Lattice index past the last cell, ``(2,)``."""
        return self.corner + self.looked.shape

    def level(self, window: Window = (slice(None), slice(None))) -> Grid:
        """Return the mean signed distance, metres, positive inside; cells never seen count as outside."""
        looked = self.looked[window]
        mean = np.full(looked.shape, -TRUNCATION, dtype=np.float32)
        return np.divide(self.distance[window], looked, out=mean, where=looked > 0)

    def grow(self, corner: Integer, stop: Integer) -> None:
        """Make room for cells ``corner`` to ``stop``; new ones were seen outside as often as their neighbours."""
        low, high = np.minimum(corner, self.corner), np.maximum(stop, self.stop)
        before, after = self.corner - low, high - self.stop
        if not (before.any() or after.any()):
            return
        inner = tuple(slice(a, a + n) for a, n in zip(before.tolist(), self.looked.shape, strict=True))
        rows, columns = (
            np.arange(low[axis] - self.corner[axis], high[axis] - self.corner[axis]).clip(
                0, self.looked.shape[axis] - 1
            )
            for axis in range(2)
        )
        edge = np.ix_(rows, columns)
        looked = self.looked[edge]
        distance = -np.float32(TRUNCATION) * looked
        distance[inner] = self.distance
        self.looked, self.distance = looked, distance
        self.seen_view = self.seen_view[edge]
        self.corner = low

    def window(self, corner: Integer, stop: Integer) -> Window:
        """Return the part of the grid that holds cells ``corner`` to ``stop``."""
        a, b = (corner - self.corner).tolist(), (stop - self.corner).tolist()
        return slice(a[0], b[0]), slice(a[1], b[1])

    def outline(self, cell: float) -> shapely.Polygon | None:
        """Return the largest fused outline in the global frame, or None; straight where it ends unseen."""
        polygons = positive_areas(self.level().astype(np.float64))
        if not polygons:
            return None
        points = shapely.get_coordinates(polygons[0])
        shape = self.looked.shape
        beside = [
            np.minimum(side(points).astype(np.int64), np.array(shape) - 1).clip(0) for side in (np.floor, np.ceil)
        ]
        unseen = np.any([self.looked[cells[:, 0], cells[:, 1]] <= 0 for cells in beside], axis=0)
        points = _straightened(points, np.asarray(unseen))
        return shapely.Polygon((points + self.corner + 0.5) * cell)


def _straightened(ring: Float, loose: Bool) -> Float:
    """Straighten the stretches of a closed ring ``(n + 1, 2)`` that are ``loose``: steps of the lattice, never seen."""
    if not loose.any() or loose.all():
        return ring
    first = int(np.argmin(loose))
    points, loose = np.roll(ring[:-1], -first, axis=0), np.roll(loose[:-1], -first)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], loose, [False]]).astype(np.int8)))
    keep = np.ones(len(points), dtype=bool)
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        run = points[start:stop]
        if len(run) > 2:
            simple = shapely.get_coordinates(shapely.simplify(shapely.LineString(run), LOOSE_TOLERANCE))
            keep[start:stop] = (run[:, None] == simple[None]).all(axis=2).any(axis=1)
    kept = points[keep]
    return np.vstack([kept, kept[:1]])


@dataclass(frozen=True)
class RingSighting:
    """Observed ring on the lattice.

    Attributes:
        observation: the ring.
        corner: ``(2,) int64``, lattice index of the first cell.
        distance: ``(rows, columns) float32``, signed distance, metres, positive inside, truncated.
        visible: ``(rows, columns) bool``, cells inside the ROI and clear of its rim.
        clear: ``(rows, columns) bool``, those of them that nothing hid.
    """

    observation: Observation
    corner: Integer
    distance: Grid
    visible: Bool
    clear: Bool

    @property
    def stop(self) -> Integer:
        """Lattice index past the last cell, ``(2,)``."""
        return self.corner + self.visible.shape

    def crop(self, corner: Integer, stop: Integer) -> RingSighting:
        """Return the part that holds cells ``corner`` to ``stop``."""
        (a, b), (c, d) = (corner - self.corner).tolist(), (stop - self.corner).tolist()
        part = slice(a, c), slice(b, d)
        return RingSighting(self.observation, corner, self.distance[part], self.visible[part], self.clear[part])


def room_of(points: Float, cell: float) -> tuple[Integer, Integer]:
    """Return the first cell and past the last that a ring ``(n, 2)`` and the truncation around it need."""
    low = np.floor((points.min(axis=0) - TRUNCATION) / cell).astype(np.int64)
    high = np.floor((points.max(axis=0) + TRUNCATION) / cell).astype(np.int64) + 1
    return low, high


def sight(
    observation: Observation,
    room: tuple[Integer, Integer],
    pose: Float,
    roi: RegionOfInterest,
    cell: float,
    visible_ground: shapely.Geometry | None = None,
) -> RingSighting:
    """Put an observed ring on the lattice.

    Args:
        observation: a ring in the global frame.
        room: first cell and past the last; holds at least the observation's own room.
        pose: ``ego_to_global`` of the frame.
        roi: what was looked at.
        cell: lattice constant, metres.
        visible_ground: what could be seen, ego frame; None for all of the ROI.
    """
    low, high = room
    own_low, own_high = room_of(observation.points, cell)
    global_to_ego = inverse_pose(pose)
    x, y = ((np.arange(low[axis], high[axis]) + 0.5) * cell for axis in range(2))
    axes, origin = global_to_ego[:2, :2], global_to_ego[:2, 3]
    forward = x[:, None] * axes[0, 0] + y[None, :] * axes[0, 1] + origin[0]
    left = x[:, None] * axes[1, 0] + y[None, :] * axes[1, 1] + origin[1]
    visible = (np.abs(forward) < roi.length / 2 - CUT_RIM) & (np.abs(left) < roi.width / 2 - CUT_RIM)
    clear = visible if visible_ground is None else visible & shapely.contains_xy(visible_ground, forward, left)
    distance = np.full(visible.shape, -TRUNCATION, dtype=np.float32)
    (a, b), (c, d) = (own_low - low).tolist(), (own_high - low).tolist()
    rim = roi.size / 2 - CUT_RIM
    local = transform_points(global_to_ego, observation.points) / rim
    cut = ((local[:-1] > 1) & (local[1:] > 1)) | ((local[:-1] < -1) & (local[1:] < -1))
    distance[a:c, b:d] = signed_distance(x[a:c], y[b:d], observation.points, np.asarray(~cut.any(axis=1)), np.float32)
    return RingSighting(observation, low, distance, visible, clear)


def new_ring(sighting: RingSighting, timestamp: int) -> FusedRing:
    """Start a crossing from its first observation."""
    zero = np.zeros(sighting.visible.shape, dtype=np.float32)
    tracks = {sighting.observation.track: 0}
    ring = FusedRing(
        sighting.corner, zero, zero.copy(), zero.copy(), 0.0, Evidence(timestamp, timestamp, 0, tracks=tracks)
    )
    fuse_ring(ring, sighting, timestamp)
    return ring


def fuse_ring(ring: FusedRing, sighting: RingSighting, timestamp: int) -> None:
    """Add an observation to a crossing, in place."""
    observation = sighting.observation
    ring.grow(sighting.corner, sighting.stop)
    window = ring.window(sighting.corner, sighting.stop)
    information = sighting.visible * np.float32(observation.curve.information.mean())
    ring.scatter += _scatter(ring, window, information, sighting.distance)
    ring.marks |= observation.curve.marks[0]
    ring.distance[window] += information * sighting.distance
    ring.looked[window] += information
    ring.seen_view[window] += sighting.clear * np.float32(observation.curve.seen_view.mean())
    ring.seen += observation.sighting
    ring.evidence.sighted(observation.track, timestamp)


def _scatter(ring: FusedRing, window: Window, information: Grid, distance: Grid) -> float:
    """Return what an observation adds to the scatter: the mean over the cells that the outline passes."""
    level, known = ring.level(window), ring.looked[window]
    beside = (np.abs(level) < BESIDE) & (information > 0) & (known > 0)
    if not beside.any():
        return 0.0
    level, known, information, distance = level[beside], known[beside], information[beside], distance[beside]
    return float((known * information / (known + information) * (distance - level) ** 2).mean())


def absorb_ring(ring: FusedRing, other: FusedRing) -> None:
    """Add all of another crossing to this one, in place."""
    ring.grow(other.corner, other.stop)
    other.grow(ring.corner, ring.stop)
    ring.distance = ring.distance + other.distance
    ring.looked = ring.looked + other.looked
    ring.seen_view = ring.seen_view + other.seen_view
    ring.seen += other.seen
    ring.scatter += other.scatter
    ring.marks = ring.marks | other.marks
    ring.evidence.absorb(other.evidence)


def same_ground(ring: FusedRing, other: FusedRing, share: float) -> bool:
    """Whether two crossings overlap, with an intersection over union of at least ``share``."""
    low, high = np.maximum(ring.corner, other.corner), np.minimum(ring.stop, other.stop)
    if (high <= low).any():
        return False
    one, two = ring.level(ring.window(low, high)) > 0, other.level(other.window(low, high)) > 0
    return bool(np.count_nonzero(one & two) >= share * np.count_nonzero(one | two))


def overlap(ring: FusedRing, sighting: RingSighting) -> float:
    """Return intersection over union of a crossing and an observed ring, where the frame and the map both know."""
    low, high = np.maximum(ring.corner, sighting.corner), np.minimum(ring.stop, sighting.stop)
    if (high <= low).any():
        return 0.0
    seen = sighting.crop(low, high)
    window = ring.window(low, high)
    known = seen.visible & (ring.looked[window] > 0)
    held, inside = (ring.distance[window] > 0) & known, (seen.distance > 0) & known
    union = np.count_nonzero(held | inside)
    return float(np.count_nonzero(held & inside)) / union if union else 0.0
