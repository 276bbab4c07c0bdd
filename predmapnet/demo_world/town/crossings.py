"""Pedestrian crossings: a ring round a junction, from corner to corner, and single ones between junctions."""

from __future__ import annotations

import numpy as np
import shapely
from numpy.random import Generator
from shapely import Polygon

from mapfusion.arrays import Float
from predmapnet.demo_world.town.cross_sections import CrossSection
from predmapnet.demo_world.town.habits import Habits
from predmapnet.demo_world.town.junctions import Junction
from predmapnet.demo_world.town.reference_line import ReferenceLine
from predmapnet.demo_world.town.street_plan import Rank, StreetPlan
from predmapnet.demo_world.world import Crossing

MOST_SKEW = np.radians(30.0)


def draw_crossings(
    random: Generator, plan: StreetPlan, sections: list[CrossSection], junction: Junction, habits: Habits
) -> dict[int, Crossing]:
    """Draw which arms of a junction are crossed, and the crossings, by arm."""
    arms = [reach.arm for reach in junction.reaches]
    if len(arms) < 3:
        return {}
    kind = random.random()
    share = 1.0 if kind < habits.ring_share else (0.0 if kind > 1 - habits.bare_share else 0.5)
    # Corners are shared: where one crossing ends in the middle of the curve, so does the next.
    meet = float(random.uniform(0.3, 0.55))
    ends = {
        (index, side): float(np.clip(random.normal(meet, 0.08), 0.05, 0.7))
        for index in range(len(arms))
        for side in (0, 1)
    }
    found: dict[int, Crossing] = {}
    for index, arm in enumerate(arms):
        is_alley = plan.streets[arm.street].rank is Rank.ALLEY
        if junction.is_minor and not is_alley:
            continue
        if random.random() > share * (0.75 if is_alley else 1.0):
            continue
        crossing = _across_arm(random, plan, sections[arm.street], junction, index, ends, habits)
        if crossing is not None:
            found[index] = crossing
    return found


def _across_arm(
    random: Generator,
    plan: StreetPlan,
    section: CrossSection,
    junction: Junction,
    index: int,
    ends: dict[tuple[int, int], float],
    habits: Habits,
) -> Crossing | None:
    """The crossing over one arm; None where there is no room."""
    arm = junction.reaches[index].arm
    line = plan.streets[arm.street].line
    left, right = junction.corners[index], junction.corners[index - 1]
    depth = float(np.clip(random.normal(3.6, 0.7), 2.2, 5.5))
    places: list[tuple[float, float] | None] = []
    for corner, backward, share in ((left, False, ends[index, 0]), (right, True, ends[index, 1])):
        curve = corner.curve[::-1] if backward else corner.curve
        if corner.is_flat or len(curve) < 3:
            places.append(None)
            continue
        point = curve[min(int(share * len(curve)), len(curve) - 1)]
        places.append(_along_and_aside(line, arm.station, arm.side, point))
    known = [place for place in places if place is not None]
    if not known:
        return None
    if len(known) == 2:
        (first, high), (second, low) = known
        lean = float(np.arctan2(first - second, high - low))
        if abs(lean) > MOST_SKEW:
            # The nearer end moves outward along its corner.
            excess = (abs(lean) - float(random.uniform(0.3, 1.0)) * MOST_SKEW) / abs(lean)
            middle = max(first, second)
            first, second = first + excess * (middle - first), second + excess * (middle - second)
            lean = float(np.arctan2(first - second, high - low))
        distance = (first + second) / 2
    else:
        distance = known[0][0]
        lean = np.radians(float(random.normal(0.0, float(random.choice([2.0, 12.0])))))
    distance = max(distance, depth / 2 + 0.3)
    if distance + depth > 0.48 * abs(arm.far - arm.station):
        return None
    limits = [np.inf if place is None else abs(place[1]) + 0.6 for place in places]
    heading = plan_heading(line, arm.station + arm.side * distance, arm.side)
    centre = line.locate(np.array([arm.station + arm.side * distance]))[0]
    walk = heading + np.pi / 2 - lean
    return between_kerbs(random, junction.surface, centre, walk, depth, (limits[0], limits[1]), habits)


def plan_heading(line: ReferenceLine, station: float, side: int) -> float:
    """Heading of a line at a station, reversed for ``side`` -1; radians."""
    return line.heading(station) + (0.0 if side == 1 else np.pi)


def _along_and_aside(line: ReferenceLine, station: float, side: int, point: Float) -> tuple[float, float]:
    """Distance of a point from a node along an arm, and to the left of it seen outward, metres."""
    here = line.shape.project(shapely.Point(point))
    place, tangent = line.locate(np.array([here]))[0], line.direction(np.array([here]))[0]
    offset = point - place
    return side * (here - station), side * float(tangent[0] * offset[1] - tangent[1] * offset[0])


def between_kerbs(
    random: Generator,
    surface: shapely.Geometry,
    centre: Float,
    walk: float,
    depth: float,
    limits: tuple[float, float],
    habits: Habits,
) -> Crossing | None:
    """Return a crossing through a place on the paved surface, from kerb to kerb, ``depth`` metres deep.

    ``walk`` is the direction of walking, to the left seen from the junction, in radians; ``limits`` are how far it may
    reach to the left and to the right of its centre.
    """
    sides = []
    for sign in (-0.5, 0.5):
        turn = walk + np.radians(float(random.normal(0.0, 1.2)))
        direction = np.array([np.cos(turn), np.sin(turn)])
        ahead = np.array([-np.sin(walk), np.cos(walk)])
        middle = centre + sign * depth * ahead
        chord = shapely.LineString([middle - 45.0 * direction, middle + 45.0 * direction]).intersection(surface)
        parts = [part for part in shapely.get_parts(chord) if part.distance(shapely.Point(middle)) < 0.5]
        if not parts:
            return None
        reach = np.sort((shapely.get_coordinates(parts[0]) - middle) @ direction)
        over = [float(random.uniform(*habits.overhang)) for _ in range(2)]
        high, low = min(reach[-1], limits[0]) + over[0], min(-reach[0], limits[1]) + over[1]
        if high + low < 3.0 or high + low > 48.0:
            return None
        sides.append((middle - low * direction, middle + high * direction))
    outline = Polygon([sides[0][0], sides[0][1], sides[1][1], sides[1][0]])
    if not outline.is_valid or outline.area < 8.0:
        return None
    style = habits.crossing_styles[random.integers(len(habits.crossing_styles))]
    surface = habits.crossing_surface if random.random() < habits.surfaced_share else ""
    wear = float(random.uniform(0.4, 0.75)) if random.random() < habits.worn_share else None
    return Crossing(shapely.geometry.polygon.orient(outline), style, float(np.angle(np.exp(1j * walk))), surface, wear)


def cross_street(
    random: Generator, line: ReferenceLine, surface: shapely.Geometry, station: float, habits: Habits
) -> Crossing | None:
    """A crossing between junctions."""
    centre = line.locate(np.array([station]))[0]
    lean = np.radians(float(random.normal(0.0, 4.0)))
    depth = float(random.uniform(2.5, 4.5))
    return between_kerbs(
        random, surface, centre, line.heading(station) + np.pi / 2 - lean, depth, (np.inf, np.inf), habits
    )
