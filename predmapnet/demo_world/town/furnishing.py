"""Furnishing of a stretch of street besides its paint: medians, openings of the kerb, parking and lanes."""

from __future__ import annotations

import numpy as np
import shapely
from numpy.random import Generator
from shapely import Polygon

from mapfusion.arrays import Float
from predmapnet.demo_world.town.cross_sections import CrossSection, Use
from predmapnet.demo_world.town.habits import Habits
from predmapnet.demo_world.town.kerbside import build_lay_bys, build_openings
from predmapnet.demo_world.town.lane_graph import lanes_between
from predmapnet.demo_world.town.medians import median_islands
from predmapnet.demo_world.town.reference_line import ReferenceLine
from predmapnet.demo_world.town.street_plan import Rank, StreetPlan
from predmapnet.demo_world.town.works import Stretch, Works, spaced


def furnish(
    random: Generator,
    plan: StreetPlan,
    section: CrossSection,
    stretches: list[Stretch],
    habits: Habits,
    works: Works,
) -> None:
    """Build everything of one street that is not paint: medians, openings, lay-bys, lanes."""
    index = stretches[0].street
    line, rank = plan.streets[index].line, plan.streets[index].rank
    own = line.shape.buffer(section.half_width + 0.2)
    taken = shapely.union_all([street.line.surroundings for n, street in enumerate(plan.streets) if n != index])
    shapely.prepare(taken)
    for stretch in stretches:
        begin, finish = stretch.inner("stop")
        low, high = stretch.inner("clear")
        low, high = low + 3.0, high - 3.0
        if finish - begin > 8.0:
            works.islands += median_islands(random, line, section, begin + 0.5, finish - 0.5)
        if finish - begin > 16.0:
            works.parking += _parking_places(line, section, spaced(begin + 3.0, finish - 3.0))
        if high - low > 8.0:
            rate = habits.openings * float(random.choice([0.4, 1.0, 2.0]))
            openings = build_openings(random, line, section, low, high, rate, taken)
            works.paved += [piece for piece in openings if piece.area > 1.0 and not piece.within(own)]
            lay_bys = build_lay_bys(random, line, section, low, high)
            works.paved += lay_bys.paved
            works.parking += lay_bys.parking
            for sign in (1, -1):
                if random.random() < habits.grass_share:
                    kerb = section.edges(np.array([low, high]))[0 if sign == 1 else -1]
                    rim = kerb + sign * 5.0
                    works.grass.append(line.band(np.array([low, high]), np.minimum(kerb, rim), np.maximum(kerb, rim)))
        _lay_lanes(line, section, stretch, rank is not Rank.ALLEY, works)


def _parking_places(line: ReferenceLine, section: CrossSection, stations: Float) -> list[Polygon]:
    """Parking areas, in pieces short enough to be straight."""
    edges = section.edges(stations)
    found = []
    for row, strip in enumerate(section.strips):
        high, low = edges[row], edges[row + 1]
        if strip.parked:
            on_left = row == 0 and len(section.strips) > 1
            high, low = (high, high - strip.parked) if on_left else (low + strip.parked, low)
        elif strip.use is not Use.PARKING:
            continue
        wide = (high - low) > 1.7
        for first in range(0, len(stations) - 1, 12):
            last = min(first + 12, len(stations) - 1)
            if wide[first : last + 1].all():
                found.append(line.band(stations[first : last + 1], low[first : last + 1], high[first : last + 1]))
    return found


def _lay_lanes(line: ReferenceLine, section: CrossSection, stretch: Stretch, main: bool, works: Works) -> None:
    """Lane polygons between the junctions, and the carriageways."""
    clear, stop = stretch.inner("clear"), stretch.inner("stop")
    if clear[1] - clear[0] < 3.0:
        middle = (clear[0] + clear[1]) / 2
        clear = (middle - 1.5, middle + 1.5)
    stations = spaced(*clear, spacing=1.0)
    edges = section.edges(stations)
    for row, strip in enumerate(section.strips):
        width = edges[row] - edges[row + 1]
        if strip.use in (Use.LANE, Use.BUS, Use.CYCLES) and width.max() > 0.6:
            wide = np.flatnonzero(width > 0.5)
            rows = slice(int(wide[0]), int(wide[-1]) + 1)
            if wide[-1] - wide[0] > 3:
                path = line.locate(stations[rows], (edges[row, rows] + edges[row + 1, rows]) / 2)
                band = line.band(stations[rows], edges[row + 1, rows], edges[row, rows])
                works.lanes.append((band, path if strip.direction == 1 else path[::-1]))
    for direction in (1, -1):
        to_stop = max(clear[1] - stop[1] if direction == 1 else stop[0] - clear[0], 0.0)
        reach = stretch.reaches[1 if direction == 1 else 0]
        waits = reach is not None and reach.stop > 0.0
        way = lanes_between(line, section, stations, direction, stretch.nodes, to_stop if waits else np.nan, main)
        if way is not None:
            works.carriageways.append(way)
