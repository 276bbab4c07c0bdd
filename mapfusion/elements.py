"""Nouns of a vector map: kinds, regions, the map of one frame and the map of a whole drive."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Any, TypeAlias

import numpy as np
import shapely
from numpy.typing import NDArray

from mapfusion.arrays import Bool, Float, Integer

Origins: TypeAlias = Mapping[str, tuple[int, ...]]
"""Ids of tracks by name of the drive or map that they belong to."""


PAINTS = ("solid", "dashed")
"""Known paint of a divider."""

LONGEST_SIDE = 2_000.0
"""Of a region of interest, metres."""


class ElementKind(IntEnum):
    """Kind of a map element; the numbers are the class ids of the nuScenes and Argoverse 2 benchmarks."""

    PED_CROSSING = 0
    DIVIDER = 1
    BOUNDARY = 2

    @property
    def label(self) -> str:
        """Lower-case name as written to files: ``ped_crossing``, ``divider``, ``boundary``."""
        return self.name.lower()

    @property
    def nouns(self) -> str:
        """Plural for people: ``crossings``, ``dividers``, ``boundaries``."""
        return ("crossings", "dividers", "boundaries")[self]

    @property
    def noun(self) -> str:
        """Singular for people: ``crossing``, ``divider``, ``boundary``."""
        return ("crossing", "divider", "boundary")[self]

    @property
    def is_ring(self) -> bool:
        """Whether elements of this kind are closed rings (first vertex repeated at the end)."""
        return self is ElementKind.PED_CROSSING


@dataclass(frozen=True)
class RegionOfInterest:
    """Rectangle around the car that is mapped in one frame.

    Attributes:
        length: extent along x (forward), metres; x lies in ``[-length / 2, length / 2]``.
        width: extent along y (left), metres.

    Raises:
        ValueError: a side is not a positive number, or longer than any camera sees.
    """

    length: float = 60.0
    width: float = 30.0

    def __post_init__(self) -> None:
        if not (0.0 < self.length <= LONGEST_SIDE and 0.0 < self.width <= LONGEST_SIDE):
            raise ValueError(
                f"a region of interest has two positive sides of at most {LONGEST_SIDE:g} m, not {self.length} m and "
                f"{self.width} m"
            )

    @property
    def size(self) -> Float:
        """``(2,) float64``: length and width, metres."""
        return np.array([self.length, self.width])


@dataclass(frozen=True)
class FrameMap:
    """Map of one frame: polylines in the ego frame, as arrays of equal length.

    Sequences become arrays and an integer of any type a plain one.

    Attributes:
        timestamp: integer nanoseconds.
        ego_to_global: ``(4, 4) float64``, maps ego coordinates to the data set's metric global frame.
        roi: the region that was looked at.
        kinds: ``(n,) int64`` of :class:`ElementKind`.
        scores: ``(n,) float64`` in ``[0, 1]``.
        track_ids: ``(n,) int64``, stable over a log and never reused; ``-1`` for an element that is reported
            (for precision-recall curves) but not tracked. Only tracked elements enter a global map.
        polylines: ``n`` arrays ``(k_i, 2) float64``, metres, ego frame; crossings are closed rings.
        forecasts: ``n`` arrays ``(p, 2) float64``, metres, where each element is expected in the ego frame of
            the *next* instant; empty arrays where there is no forecast. ``None`` without a forecaster.
        segmentation: ``(3, rows, columns) float32`` probabilities per kind over the ROI; row 0 is the largest
            y, column 0 the smallest x. ``None`` if the mapper makes none.
        history_masks: ``(n, rows, columns) float32``, raster memory of each element, same grid convention.
        visible: rings ``(k, 2) float64``, metres, ego frame, around the ground that could be seen at that instant; a
            ring within another is a hole; see :func:`mapfusion.ground.visible_ground`. ``None``: all of the ROI.
        ground_height: z of the road under the car, metres, ego frame: zero where the ego origin lies on the road.
    """

    timestamp: int
    ego_to_global: Float
    roi: RegionOfInterest
    kinds: Integer
    scores: Float
    track_ids: Integer
    polylines: tuple[Float, ...]
    forecasts: tuple[Float, ...] | None = None
    segmentation: NDArray[np.float32] | None = None
    history_masks: NDArray[np.float32] | None = None
    visible: tuple[Float, ...] | None = None
    ground_height: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "timestamp", int(self.timestamp))
        for name in ("ego_to_global", "kinds", "scores", "track_ids"):
            object.__setattr__(self, name, np.asarray(getattr(self, name)))
        lengths = {len(self.kinds), len(self.scores), len(self.track_ids), len(self.polylines)}
        if len(lengths) != 1:
            raise ValueError(f"kinds, scores, track_ids and polylines differ in length: {sorted(lengths)}")

    def __len__(self) -> int:
        return len(self.polylines)

    def select(self, mask: Bool) -> FrameMap:
        """Return the elements where ``mask`` (``(n,) bool``) is true."""
        rows = np.flatnonzero(mask)
        return replace(
            self,
            kinds=self.kinds[rows],
            scores=self.scores[rows],
            track_ids=self.track_ids[rows],
            polylines=tuple(self.polylines[row] for row in rows),
            forecasts=None if self.forecasts is None else tuple(self.forecasts[row] for row in rows),
            history_masks=None if self.history_masks is None else self.history_masks[rows],
        )

    @property
    def tracked(self) -> FrameMap:
        """Only the elements that carry a track id."""
        return self.select(self.track_ids >= 0)


@dataclass(frozen=True)
class MapElement:
    """Element of a global map.

    Attributes:
        kind: divider, boundary or crossing.
        points: ``(n, 2) float64``, metres, global frame; a crossing is a closed ring.
        confidence: in ``[0, 1]``.
        observations: number of frames that saw it.
        first_seen, last_seen: integer nanoseconds.
        track_ids: ids of the tracks that were fused into it, ascending; those of several drives may be equal by
            chance, ``source_track_ids`` tells them apart.
        deviation: ``(n,) float64``, metres, standard deviation of each vertex across the line, if known: 95 % of the
            true curve lies within 1.96 deviations of this one, measured across it. What of the detector's error does
            not average out is in it (:mod:`mapfusion.integrate.uncertainty`); an offset of the poses as a whole is not.
        sources: names of the drives, or of the maps if those do not name any, that it comes from, ascending.
        source_track_ids: ids of the tracks in each of the sources, in their order.
        heights: ``(n,) float64``, metres, of the road at each vertex, z of the global frame, if known.
        name: the same from run to run; empty until a file gives it one (:mod:`mapfusion.formats.identities`).
        paint: of a divider, ``solid`` or ``dashed``; empty where it is not known.
    """

    kind: ElementKind
    points: Float
    confidence: float
    observations: int
    first_seen: int
    last_seen: int
    track_ids: tuple[int, ...] = ()
    deviation: Float | None = None
    sources: tuple[str, ...] = ()
    source_track_ids: tuple[tuple[int, ...], ...] = ()
    heights: Float | None = None
    name: str = ""
    paint: str = ""

    @property
    def length(self) -> float:
        """Length of the line (perimeter of a ring), metres."""
        return float(np.linalg.norm(np.diff(self.points, axis=0), axis=1).sum())

    @property
    def extent(self) -> tuple[float, float]:
        """Longer and shorter side of the smallest rectangle around a crossing, metres; length of a line, and 0."""
        if not self.kind.is_ring:
            return self.length, 0.0
        corners = shapely.get_coordinates(shapely.oriented_envelope(shapely.LinearRing(self.points)))
        sides = np.linalg.norm(np.diff(corners[:3], axis=0), axis=1).tolist()
        return max(sides, default=0.0), min(sides, default=0.0)

    @property
    def origins(self) -> Origins:
        """Ids of the tracks by source; those of a nameless one, ``""``, if no source is named."""
        if not self.sources:
            return {"": self.track_ids}
        tracks = self.source_track_ids or ((),) * len(self.sources)
        return dict(zip(self.sources, tracks, strict=True))

    def with_vertices(self, rows: Integer) -> MapElement:
        """Return it with some of its vertices, or all in another order, by their rows."""
        deviation, heights = (None if values is None else values[rows] for values in (self.deviation, self.heights))
        return replace(self, points=self.points[rows], deviation=deviation, heights=heights)

    def counter_clockwise(self) -> MapElement:
        """Return a ring that turns counter-clockwise; a line as it is."""
        x, y = (self.points - self.points[0]).T
        turns_back = self.kind.is_ring and float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum()) < 0.0
        return self.with_vertices(np.arange(len(x))[::-1]) if turns_back else self

    def with_origins(self, origins: Origins) -> MapElement:
        """Return it with other sources and tracks."""
        named = sorted(set(origins) - {""})
        return replace(
            self,
            track_ids=tuple(sorted({track for tracks in origins.values() for track in tracks})),
            sources=tuple(named),
            source_track_ids=tuple(tuple(sorted(origins[name])) for name in named),
        )


def united_origins(several: Iterable[Origins]) -> dict[str, tuple[int, ...]]:
    """Return the union of the sources and tracks of several elements."""
    found: dict[str, set[int]] = {}
    for origins in several:
        for name, tracks in origins.items():
            found.setdefault(name, set()).update(tracks)
    return {name: tuple(sorted(tracks)) for name, tracks in found.items()}


@dataclass(frozen=True)
class GlobalMap:
    """Map of one or more drives: elements in one metric global frame, and their provenance.

    Attributes:
        elements: of the map.
        provenance: its origin, as files keep it.
        notes: of the reader of a file: what was repaired, supplied or left out, for the user.
    """

    elements: tuple[MapElement, ...]
    provenance: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.elements)

    def __iter__(self) -> Iterator[MapElement]:
        return iter(self.elements)

    def of_kind(self, kind: ElementKind) -> tuple[MapElement, ...]:
        """Return the elements of one kind, in map order."""
        return tuple(element for element in self.elements if element.kind == kind)

    def moved(self, motion: Callable[[Float], Float]) -> GlobalMap:
        """Return the map with a motion of points ``(n, 2)`` applied to all elements."""
        elements = tuple(replace(element, points=motion(element.points)) for element in self)
        return GlobalMap(elements, self.provenance, self.notes)

    def length(self, kind: ElementKind) -> float:
        """Total length of one kind, metres; of crossings the sum of their longer sides."""
        return sum(element.extent[0] for element in self.of_kind(kind))
