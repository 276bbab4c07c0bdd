"""A crossing of the map: an occupancy grid that holds how often each cell lay inside its observed rings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from mapfusion.contour import level_polygons
from mapfusion.elements import ElementKind, RegionOfInterest
from mapfusion.geometry import inverse_pose, transform_points
from mapfusion.lines import Evidence
from mapfusion.observations import Observation

Float = NDArray[np.float64]
Grid = NDArray[np.float32]
Integer = NDArray[np.int64]

MARGIN = 1.5
"""Room around a ring when its grid is made, metres."""


@dataclass
class FusedRing:
    """A crossing of the map, as sums over the observations per cell of a lattice common to the whole map.

    The share ``inside / looked`` of a cell does not depend on the order of observations, nor on where a ring starts
    or which way it runs; its outline at one half is the median of the observed rings (Vorob'ev). Cells outside the
    ROI of an observation count neither way, so an end that the ROI has cut is not an end.

    Attributes:
        corner: ``(2,) int64``, lattice index of the first cell.
        inside: ``(rows, columns) float32``, information of the observations that hold the cell inside.
        looked: the same of all observations that had the cell in their ROI.
        seen_view: sum of the view weights of the observations.
        seen: sum of sightings, weighted by score.
    """

    corner: Integer
    inside: Grid
    looked: Grid
    seen_view: Grid
    seen: float
    evidence: Evidence
    kind: ElementKind = ElementKind.PED_CROSSING

    @property
    def share(self) -> Grid:
        """``(rows, columns) float32`` in ``[0, 1]``: how surely each cell belongs to the crossing."""
        return np.divide(self.inside, np.maximum(self.looked, 1e-6), dtype=np.float32)

    @property
    def stop(self) -> Integer:
        """Lattice index past the last cell, ``(2,)``."""
        return self.corner + self.inside.shape

    def grow(self, corner: Integer, stop: Integer) -> None:
        """Make room for cells ``corner`` to ``stop``; new cells have been looked at as often as their neighbours."""
        low, high = np.minimum(corner, self.corner), np.maximum(stop, self.stop)
        before, after = self.corner - low, high - self.stop
        if not (before.any() or after.any()):
            return
        width = ((before[0], after[0]), (before[1], after[1]))
        self.inside = np.pad(self.inside, width)
        self.looked = np.pad(self.looked, width, mode="edge")
        self.seen_view = np.pad(self.seen_view, width, mode="edge")
        self.corner = low

    def outlines(self, cell: float) -> list[shapely.Polygon]:
        """Return the fused outlines in the global frame, largest first."""
        polygons = level_polygons(self.share.astype(np.float64), 0.5)
        return [shapely.Polygon((shapely.get_coordinates(p) + self.corner + 0.5) * cell) for p in polygons]


@dataclass(frozen=True)
class RingSighting:
    """An observed ring on the lattice; attributes as in :class:`FusedRing`, of one frame."""

    observation: Observation
    corner: Integer
    inside: NDArray[np.bool_]
    information: Grid
    view: Grid

    @property
    def stop(self) -> Integer:
        """Lattice index past the last cell, ``(2,)``."""
        return self.corner + self.inside.shape


def sight(
    observation: Observation, room: tuple[Integer, Integer] | None, pose: Float, roi: RegionOfInterest, cell: float
) -> RingSighting:
    """Put an observed ring on the lattice.

    Args:
        observation: a ring in the global frame.
        room: first cell and past the last of the ring of the map that it may belong to; None for the
            observation's own box and a margin.
        pose: ``ego_to_global`` of the frame.
        roi: what was looked at.
        cell: lattice constant, metres.
    """
    low = np.floor((observation.points.min(axis=0) - MARGIN) / cell).astype(np.int64)
    high = np.floor((observation.points.max(axis=0) + MARGIN) / cell).astype(np.int64) + 1
    if room is not None:
        low, high = np.minimum(low, room[0]), np.maximum(high, room[1])
    x, y = np.meshgrid(*(np.arange(low[axis], high[axis]) + 0.5 for axis in range(2)), indexing="ij")
    centres = np.stack([x, y], axis=-1).reshape(-1, 2) * cell
    polygon = shapely.Polygon(observation.points)
    shapely.prepare(polygon)
    inside = shapely.contains_xy(polygon, centres[:, 0], centres[:, 1])
    ego = np.abs(transform_points(inverse_pose(pose), centres))
    in_roi = (ego < roi.size / 2 - cell / 2).all(axis=1)
    shape = x.shape
    information = np.where(in_roi, observation.information.mean(), 0.0).astype(np.float32)
    view = np.where(in_roi, observation.view.mean(), 0.0).astype(np.float32)
    return RingSighting(
        observation, low, (inside & in_roi).reshape(shape), information.reshape(shape), view.reshape(shape)
    )


def new_ring(sighting: RingSighting, timestamp: int) -> FusedRing:
    """Start a crossing from its first observation."""
    observation = sighting.observation
    return FusedRing(
        corner=sighting.corner,
        inside=np.where(sighting.inside, sighting.information, np.float32(0)),
        looked=sighting.information.copy(),
        seen_view=sighting.view.copy(),
        seen=observation.sighting,
        evidence=Evidence(timestamp, timestamp, tracks={observation.track_id: 1}),
    )


def fuse_ring(ring: FusedRing, sighting: RingSighting) -> None:
    """Add an observation to a crossing, in place; the sighting was made with the ring's room."""
    ring.grow(sighting.corner, sighting.stop)
    start = sighting.corner - ring.corner
    window = tuple(slice(a, a + n) for a, n in zip(start, sighting.inside.shape, strict=True))
    ring.inside[window] += np.where(sighting.inside, sighting.information, np.float32(0))
    ring.looked[window] += sighting.information
    ring.seen_view[window] += sighting.view
    ring.seen += sighting.observation.sighting


def merge_rings(ring: FusedRing, other: FusedRing) -> None:
    """Add all of another crossing to this one, in place."""
    ring.grow(other.corner, other.stop)
    other.grow(ring.corner, ring.stop)
    ring.inside = ring.inside + other.inside
    ring.looked = ring.looked + other.looked
    ring.seen_view = ring.seen_view + other.seen_view
    ring.seen += other.seen
    ring.evidence.absorb(other.evidence)


def common_share(ring: FusedRing, sighting: RingSighting) -> float:
    """Return the common area over the smaller of both, as far as the frame could see them."""
    low, high = np.maximum(ring.corner, sighting.corner), np.minimum(ring.stop, sighting.stop)
    if (high <= low).any():
        return 0.0
    a, b = low - ring.corner, high - ring.corner
    c, d = low - sighting.corner, high - sighting.corner
    held = ring.share[a[0] : b[0], a[1] : b[1]] > 0.5
    seen = sighting.inside[c[0] : d[0], c[1] : d[1]]
    visible = held & (sighting.information[c[0] : d[0], c[1] : d[1]] > 0)
    common = float((held & seen).sum())
    smaller = min(float(sighting.inside.sum()), float(visible.sum()))
    return common / smaller if smaller > 0 else 0.0
