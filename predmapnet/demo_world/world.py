"""The nouns of the demo world: what is true about the road, what stands on it, and how it looks.

A :class:`VectorMap` and a :class:`Trajectory` come from a town generator or from a real data set;
:func:`predmapnet.demo_world.street.dressing.dress` turns them into a :class:`World`, which the renderer draws.
Coordinates are metres in the global frame. The map lies in the plane z = 0, and so does the road surface unless the
world has a terrain, which raises all that is at (x, y) by the height of the ground there.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from shapely import Polygon

from mapfusion.arrays import Float

if TYPE_CHECKING:
    from predmapnet.demo_world.terrain import Terrain


class LineStyle(StrEnum):
    """Paint of a divider."""

    SOLID = "solid"
    DASHED = "dashed"
    DOUBLE_SOLID = "double_solid"
    SOLID_DASHED = "solid_dashed"
    UNPAINTED = "unpainted"


class CrossingStyle(StrEnum):
    """Paint of a pedestrian crossing."""

    ZEBRA = "zebra"
    """Bars along the direction of travel of the cars."""
    LADDER = "ladder"
    """The same bars between two lines across the road."""
    LINES = "lines"
    """Only the two lines across the road."""


class Look(StrEnum):
    """Light and weather of a scene."""

    DAY = "day"
    DUSK = "dusk"
    OVERCAST = "overcast"
    WET = "wet"
    NIGHT = "night"


@dataclass(frozen=True)
class Divider:
    """A line between lanes.

    Attributes:
        points: ``(n, 2) float64``, metres.
        style: paint at its beginning.
        colour: ``white`` or ``yellow``.
        opposite: True where it separates opposite directions (``road_divider`` of nuScenes).
        changes: (distance, style): where along the line, metres from its beginning, the paint changes to what.
    """

    points: Float
    style: LineStyle
    colour: str = "white"
    opposite: bool = False
    changes: tuple[tuple[float, LineStyle], ...] = ()


@dataclass(frozen=True)
class Hatching:
    """An area of the road that is kept free by parallel stripes: a polygon, their direction (radians), a colour."""

    polygon: Polygon
    heading: float
    colour: str = "white"


@dataclass(frozen=True)
class Crossing:
    """A pedestrian crossing.

    Attributes:
        polygon: its outline, metres.
        style: its paint.
        heading: the direction in which pedestrians walk, radians.
        surface: what the ground below the paint is made of; the road's own where empty.
        wear: share of the paint that is gone; None where it is as with any other paint.
    """

    polygon: Polygon
    style: CrossingStyle
    heading: float
    surface: str = ""
    wear: float | None = None


@dataclass(frozen=True)
class VectorMap:
    """The true road, the source of all ground truth.

    Attributes:
        road_segments: drivable surface; islands and medians are holes (or gaps).
        lanes: lane polygons, inside the road segments (may be empty for maps without lanes).
        crossings, dividers: painted elements.
        walkways: sidewalks; may be empty, then the dressing makes them up along the kerb.
        parking: parking bays (part of the road surface).
        stop_lines: polygons.
        lane_paths: centre line ``(n, 2)`` of each lane in the direction of travel; empty where not known.
        markings: painted lines that divide no lanes: along kerbs and parking, around painted gaps.
        hatchings: painted areas between such lines.
        left_hand: traffic keeps to the left.
    """

    road_segments: tuple[Polygon, ...]
    lanes: tuple[Polygon, ...]
    crossings: tuple[Crossing, ...]
    dividers: tuple[Divider, ...]
    walkways: tuple[Polygon, ...] = ()
    parking: tuple[Polygon, ...] = ()
    stop_lines: tuple[Polygon, ...] = ()
    lane_paths: tuple[Float, ...] = ()
    markings: tuple[Divider, ...] = ()
    hatchings: tuple[Hatching, ...] = ()
    left_hand: bool = False


@dataclass(frozen=True)
class Trajectory:
    """Poses of the ego car at the key frames: ``(n,) int64`` nanoseconds and ``(n, 4, 4) float64``.

    The ego origin is on the ground below the rear axle; small pitch and roll are included.
    """

    timestamps: NDArray[np.int64]
    ego_to_global: Float


@dataclass(frozen=True)
class Surface:
    """A patch of ground of one material, painted over what lies below it."""

    polygon: Polygon
    material: str


@dataclass(frozen=True)
class Solids:
    """Things that stand on the ground and occlude, as arrays of equal length.

    Attributes:
        shape: ``(n,)`` of ``box``, ``cylinder``, ``ellipsoid`` (crowns of trees).
        centre: ``(n, 3) float64``, metres; z above the ground below the centre.
        size: ``(n, 3) float64``: length, width, height, metres.
        yaw: ``(n,) float64``, radians.
        colour: ``(n, 3) float64``, linear RGB in [0, 1].
        texture: ``(n,)`` of ``plain``, ``facade``, ``vehicle``, ``foliage``, ``bark``, ``lamp`` (shines at night),
            ``sign``.
        velocity: ``(n, 2) float64``, metres per second; moving vehicles follow a straight line around their
            position at the trajectory's first timestamp. Zero for what stands still.
        lifetime: ``(n, 2) float64``, seconds since the first timestamp, between which a solid is there; None where
            all of them always are. A vehicle in a bend is a chain of straight pieces, one after the other.
    """

    shape: NDArray[np.str_]
    centre: Float
    size: Float
    yaw: Float
    colour: Float
    texture: NDArray[np.str_]
    velocity: Float
    lifetime: Float | None = None

    @property
    def always(self) -> NDArray[np.bool_]:
        """``(n,) bool``: which solids are there all the time."""
        if self.lifetime is None:
            return np.ones(len(self.shape), dtype=bool)
        return np.asarray(np.isinf(self.lifetime).all(axis=1))


@dataclass(frozen=True)
class Clutter:
    """Things on the ground that are no elements of the map, though they may look like one.

    Attributes:
        patches: (material, ``(n, 4, 2)`` quadrilaterals, metres), each over those before it.
        paint, coats: ``(n, 4, 2)`` painted quadrilaterals and ``(n, 3)``: wear, albedo, 1 for yellow and 0 for white.
        stains: (``(4, 2)`` outline, light that is left, [0, 255]): tracks of tyres and oil.
        shadows: the same for shadows of what stands out of sight; drawn where the sun shines.
        kerbs: shares of stretches whose kerb is light, grey, dark, or not to be seen at all.
    """

    patches: tuple[tuple[str, Float], ...] = ()
    paint: Float = field(default_factory=lambda: np.zeros((0, 4, 2)))
    coats: Float = field(default_factory=lambda: np.zeros((0, 3)))
    stains: tuple[tuple[Float, int], ...] = ()
    shadows: tuple[tuple[Float, int], ...] = ()
    kerbs: tuple[float, float, float, float] = (0.36, 0.34, 0.16, 0.14)


@dataclass(frozen=True)
class World:
    """Everything that the renderer needs to draw one scene. Deterministic in ``seed``.

    The trajectory stands on the terrain; None is flat ground. What is no road lies ``kerb_height`` metres higher.
    """

    name: str
    seed: int
    look: Look
    map: VectorMap
    trajectory: Trajectory
    surfaces: tuple[Surface, ...] = field(repr=False)
    solids: Solids = field(repr=False)
    clutter: Clutter = field(default_factory=Clutter, repr=False)
    terrain: Terrain | None = field(default=None, repr=False)
    kerb_height: float = 0.0
