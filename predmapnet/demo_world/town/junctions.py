"""Junctions: the paved outline, the curve of each corner, and how far a junction reaches along its arms."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import shapely
from numpy.random import Generator
from shapely import Polygon

from mapfusion.arrays import Float
from predmapnet.demo_world.town.cross_sections import CrossSection
from predmapnet.demo_world.town.street_plan import Arm, Rank, StreetPlan

LOCAL_REACH = 65.0
"""Length of the arms that belongs to a junction, metres."""

FLAT = np.radians(152.0)
"""Two arms at a larger angle than this have no corner between them."""


@dataclass
class ArmReach:
    """Reach of a junction along one arm; distances from the node, metres.

    Attributes:
        arm: which.
        left_clear, right_clear: where the kerb has left the corner, seen outward.
        stop: where arriving cars stop and lines may begin; 0 where the street runs through without a break.
        paint: where lines begin, at or beyond ``stop``.
    """

    arm: Arm
    left_clear: float
    right_clear: float
    stop: float = 0.0
    paint: float = 0.0

    @property
    def clear(self) -> float:
        """Distance along an arm at which the kerbs of both sides have left the corners."""
        return max(self.left_clear, self.right_clear)


@dataclass
class Corner:
    """The kerb between an arm and the next one anticlockwise, ``gap`` radians further: ``curve (n, 2)``, metres."""

    gap: float
    radius: float
    curve: Float

    @property
    def is_flat(self) -> bool:
        """Whether the kerb just goes on."""
        return bool(self.gap > FLAT)


@dataclass
class Junction:
    """A node with its surroundings.

    Attributes:
        node: index in the plan.
        surface: paved outline of the node and of its arms up to 65 m.
        reaches, corners: one for each arm, anticlockwise; corner i lies between arm i and arm i + 1.
        is_minor: whether one street runs through and only alleys join it.
        islands: that guide traffic turning at a slip lane.
    """

    node: int
    surface: shapely.Geometry
    reaches: list[ArmReach]
    corners: list[Corner]
    is_minor: bool
    islands: list[Polygon] = field(default_factory=list)


def arm_band(plan: StreetPlan, section: CrossSection, arm: Arm, reach: float = LOCAL_REACH) -> Polygon:
    """The surface of an arm, from a metre behind its node outward."""
    length = min(reach, abs(arm.far - arm.station))
    distances = np.concatenate([[-1.0, 0.0, 0.02], np.arange(1.0, length, 2.0), [length]])
    stations = np.sort(arm.station + arm.side * distances)
    edges = section.edges(stations)
    return plan.streets[arm.street].line.band(stations, edges[-1], edges[0])


def build_junction(random: Generator, plan: StreetPlan, sections: list[CrossSection], node: int) -> Junction:
    """Pave one node: round its corners, and find where its arms have their own width."""
    arms = plan.arms(node)
    bands = [arm_band(plan, sections[arm.street], arm) for arm in arms]
    united = shapely.union_all(bands)
    if len(arms) == 1:
        return _dead_end(random, plan, sections, node, arms[0], united)
    headings = np.array([plan.heading(arm) for arm in arms])
    gaps = np.diff(np.append(headings, headings[0] + 2 * np.pi))
    corners, fillets, islands = [], [united], []
    for index, gap in enumerate(gaps):
        ranks = {plan.streets[arms[k % len(arms)].street].rank for k in (index, index + 1)}
        radius = _draw_radius(random, ranks)
        wedge = _wedge(plan.nodes[node], headings[index], gap)
        if gap < FLAT:
            fillet = _closed(united, radius).intersection(wedge)
            slip = Rank.ALLEY not in ranks and Rank.ARTERIAL in ranks and np.radians(55) < gap < np.radians(130)
            if slip and random.random() < 0.12:
                fillet, island = _slip_lane(random, united, wedge)
                islands += island
            fillets.append(fillet)
        corners.append(Corner(float(gap), radius, np.zeros((0, 2))))
    surface = _largest(shapely.union_all(fillets))
    reaches = [ArmReach(arm, *_clears(plan, sections[arm.street], arm, surface)) for arm in arms]
    through = [arm.street for arm in arms if plan.streets[arm.street].rank is not Rank.ALLEY]
    is_minor = len(through) == 2 and through[0] == through[1] and len(arms) > 2
    junction = Junction(node, surface, reaches, corners, is_minor, islands)
    for index in range(len(arms)):
        corners[index].curve = _corner_curve(plan, sections, junction, index)
    return junction


def _dead_end(
    random: Generator, plan: StreetPlan, sections: list[CrossSection], node: int, arm: Arm, band: shapely.Geometry
) -> Junction:
    surface = band
    if random.random() < 0.3:
        half = sections[arm.street].half_width
        circle = shapely.Point(plan.nodes[node]).buffer(half + float(random.uniform(1.0, 5.0)), 16)
        surface = _closed(shapely.union(band, circle), 4.0)
    reach = ArmReach(arm, *_clears(plan, sections[arm.street], arm, surface))
    return Junction(node, surface, [reach], [], False)


def _draw_radius(random: Generator, ranks: set[Rank]) -> float:
    if Rank.ALLEY in ranks:
        return float(random.uniform(0.8, 4.0))
    if Rank.LOCAL in ranks:
        return float(random.uniform(2.5, 7.5))
    return float(random.uniform(4.0, 12.0))


def _closed(shape: shapely.Geometry, radius: float) -> shapely.Geometry:
    return shape.buffer(radius, quad_segs=10).buffer(-radius, quad_segs=10)


def _largest(shape: shapely.Geometry) -> Polygon:
    polygon: Polygon = max(shapely.get_parts(shape), key=lambda part: part.area)
    return polygon


def _wedge(centre: Float, heading: float, gap: float) -> Polygon:
    angles = heading + np.linspace(0.0, gap, 8)
    rim = centre + (LOCAL_REACH + 30.0) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return Polygon(np.concatenate([centre[None], rim]))


def _slip_lane(random: Generator, united: shapely.Geometry, wedge: Polygon) -> tuple[shapely.Geometry, list[Polygon]]:
    """A wide corner with an island in it."""
    fillet = _closed(united, float(random.uniform(17.0, 28.0)))
    inner = fillet.buffer(-float(random.uniform(4.0, 5.5))).intersection(wedge)
    island = inner.difference(united.buffer(float(random.uniform(0.4, 1.2))))
    rounded = island.buffer(-0.5).buffer(0.5, quad_segs=4)
    kept = [part for part in shapely.get_parts(rounded) if part.geom_type == "Polygon" and part.area > 5.0]
    return fillet.intersection(wedge), kept


def _clears(plan: StreetPlan, section: CrossSection, arm: Arm, surface: shapely.Geometry) -> tuple[float, float]:
    """Distances at which the kerb on the left and on the right, seen outward, has left the corner."""
    reach = min(LOCAL_REACH - 5.0, 0.62 * abs(arm.far - arm.station))
    distances = np.arange(0.25, max(reach, 1.0), 0.5)
    stations = arm.station + arm.side * distances
    edges = section.edges(stations)
    line = plan.streets[arm.street].line
    found = []
    for outward_left in (True, False):
        on_left = outward_left == (arm.side == 1)
        offsets = edges[0] + 0.15 if on_left else edges[-1] - 0.15
        inside = shapely.contains_xy(surface, line.locate(stations, offsets))
        found.append(float(distances[np.flatnonzero(inside)[-1]] + 0.5) if inside.any() else 0.5)
    return found[0], found[1]


def kerb_point(plan: StreetPlan, section: CrossSection, arm: Arm, distance: float, outward_left: bool) -> Float:
    """The kerb of an arm at a distance from its node, ``(2,)`` metres."""
    station = np.array([arm.station + arm.side * distance])
    edges = section.edges(station)
    on_left = outward_left == (arm.side == 1)
    point: Float = plan.streets[arm.street].line.locate(station, edges[0] if on_left else edges[-1])[0]
    return point


def _corner_curve(plan: StreetPlan, sections: list[CrossSection], junction: Junction, index: int) -> Float:
    here, following = junction.reaches[index], junction.reaches[(index + 1) % len(junction.reaches)]
    first = kerb_point(plan, sections[here.arm.street], here.arm, here.left_clear, True)
    last = kerb_point(plan, sections[following.arm.street], following.arm, following.right_clear, False)
    ring = shapely.LineString(shapely.geometry.polygon.orient(junction.surface).exterior.coords)
    begin, end = ring.project(shapely.Point(first)), ring.project(shapely.Point(last))
    if end < begin:
        end += ring.length
    along = np.linspace(begin, end, max(2, int((end - begin) / 0.5) + 1)) % ring.length
    curve: Float = shapely.get_coordinates(shapely.line_interpolate_point(ring, along))
    return curve
