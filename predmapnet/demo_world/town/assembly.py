"""The map of a town, assembled from what was built."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import shapely
from shapely import Polygon

from predmapnet.demo_world.town.cross_sections import CrossSection
from predmapnet.demo_world.town.habits import Habits
from predmapnet.demo_world.town.street_plan import StreetPlan
from predmapnet.demo_world.town.works import Stretch, Works, spaced
from predmapnet.demo_world.world import Divider, LineStyle, VectorMap

UNPAINTED_SHARE = 0.02
"""Of the length of all dividers: lanes that are known to be two though no line says so."""


def assemble(
    plan: StreetPlan, sections: list[CrossSection], stretches: list[Stretch], habits: Habits, works: Works
) -> tuple[VectorMap, Polygon]:
    """Cut islands out of the pavement and divide it into stretches and junctions.

    Returns the map, and the whole paved surface without islands.
    """
    outline = _outline(works)
    islands = shapely.union_all(works.islands).intersection(outline.buffer(-0.8))
    islands = shapely.union_all(_polygons(islands, 1.6))
    surface = max(shapely.get_parts(outline.difference(islands)), key=lambda part: part.area)
    inner = surface.buffer(-0.02)
    shapely.prepare(inner)
    lanes = [(part, path) for lane, path in works.lanes for part in _polygons(inner.intersection(lane), 2.0)]
    walkways = outline.buffer(habits.walkway_width, quad_segs=4).difference(outline)
    if works.grass:
        walkways = walkways.difference(shapely.union_all(works.grass))
    vector_map = VectorMap(
        road_segments=_segments(plan, sections, stretches, surface),
        lanes=tuple(lane for lane, _ in lanes),
        crossings=tuple(
            replace(crossing, polygon=part)
            for crossing in works.crossings
            for part in _polygons(crossing.polygon.difference(islands), 4.0)
        ),
        dividers=_painted_or_few(works.dividers),
        walkways=tuple(_polygons(walkways, 2.0)),
        parking=tuple(bay for bay in works.parking if bay.is_valid),
        stop_lines=tuple(works.stop_lines),
        lane_paths=tuple(path for _, path in lanes),
        markings=tuple(works.markings),
        hatchings=tuple(works.hatchings),
    )
    return vector_map, surface


def _outline(works: Works) -> Polygon:
    """All that is paved, as one piece; slits and needles where pieces meet are closed."""
    outline = shapely.union_all(works.paved)
    outline = outline.buffer(0.15, join_style="mitre").buffer(-0.3, join_style="mitre").buffer(0.15, join_style="mitre")
    outline = max(shapely.get_parts(outline), key=lambda part: part.area).simplify(0.03)
    return Polygon(outline.exterior, [ring for ring in outline.interiors if Polygon(ring).area > 6.0])


def _segments(
    plan: StreetPlan, sections: list[CrossSection], stretches: list[Stretch], surface: Polygon
) -> tuple[Polygon, ...]:
    """The surface in pieces, stretches first and then junctions, which overlap by 20 cm and so leave no seam."""
    bands: list[Polygon] = []
    cutters: list[Polygon] = []
    for stretch in stretches:
        line, section = plan.streets[stretch.street].line, sections[stretch.street]
        low, high = stretch.inner("clear")
        low, high = (low + 1.0, high - 1.0)
        if high - low < 4.0:
            continue
        reach = section.half_width + 4.0
        for inset, target in ((0.0, bands), (0.2, cutters)):
            stations = spaced(low + inset, high - inset)
            aside = np.full(len(stations), reach - inset)
            target.append(line.band(stations, -aside, aside))
    pieces = [piece for band in bands for piece in _polygons(surface.intersection(band), 0.01)]
    return (*pieces, *_polygons(surface.difference(shapely.union_all(cutters)), 0.01))


def _painted_or_few(dividers: list[Divider]) -> tuple[Divider, ...]:
    """All painted dividers, and unpainted ones up to a small share of the length."""
    painted = [divider for divider in dividers if divider.style is not LineStyle.UNPAINTED]
    allowed = UNPAINTED_SHARE * sum(shapely.LineString(divider.points).length for divider in painted)
    for divider in dividers:
        if divider.style is LineStyle.UNPAINTED:
            length = shapely.LineString(divider.points).length
            if length <= allowed:
                painted.append(divider)
                allowed -= length
    return tuple(painted)


def _polygons(geometry: shapely.Geometry, least: float) -> list[Polygon]:
    """Polygons of a geometry, without crumbs below ``least`` square metres."""
    return [part for part in shapely.get_parts(geometry) if part.geom_type == "Polygon" and part.area >= least]
