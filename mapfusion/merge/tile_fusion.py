"""Fusion of what several maps have in one tile: lines cut at its sides, and its crossings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import shapely

from mapfusion.arrays import Float
from mapfusion.elements import ElementKind, GlobalMap, MapElement
from mapfusion.merge.config import MergeConfig
from mapfusion.merge.contribution import Contribution, Looks
from mapfusion.merge.lines import fuse_lines
from mapfusion.merge.rings import fuse_rings
from mapfusion.merge.tiles import MergedLine, Tile, cut_line
from mapfusion.road_heights import RoadHeights, mean_heights


def fuse_tile(
    tile: Tile, maps: Sequence[tuple[str, int, GlobalMap, shapely.Geometry]], config: MergeConfig
) -> tuple[list[MergedLine], list[MapElement]]:
    """Fuse what the maps have in a tile and its margin; return the lines, cut at its sides, and its crossings.

    Of each map there are the name, the number, the elements and the ground that it speaks of, metres.
    """
    low, high = tile.low - config.margin, tile.high + config.margin
    looks = [Looks(part for element in found for part in _in_box(element, low, high)) for _, _, found, _ in maps]
    lines: list[MergedLine] = []
    rings: list[MapElement] = []
    for kind in ElementKind:
        contributions = []
        for (name, number, found, ground), looked in zip(maps, looks, strict=True):
            parts = (part for element in found.of_kind(kind) for part in _in_box(element, low, high))
            contributions.append(Contribution(number, [named(part, name) for part in parts], ground, looked))
        if kind.is_ring:
            rings.extend(ring for ring in fuse_rings(contributions, config) if _owns(tile, ring))
            continue
        for line in fuse_lines(kind, contributions, config):
            for points, values in cut_line(line.points, _with_heights(line, contributions), tile.low, tile.high):
                lines.append(replace(line, points=points, values=values))
    return lines, rings


def _with_heights(line: MergedLine, contributions: Sequence[Contribution]) -> Float:
    """Return the values of a line with the mean height of the elements that it comes from as a third column."""
    fields = [
        RoadHeights.of_elements(
            element
            for element in contribution.elements
            if any(
                set(tracks) & set(line.origins.get(name, ())) or not tracks for name, tracks in element.origins.items()
            )
        )
        for contribution in contributions
    ]
    return np.column_stack([line.values, mean_heights(fields, line.points)])


def named(element: MapElement, name: str) -> MapElement:
    """Return an element that says where it comes from: what it says already, or the map that holds it."""
    return element.with_origins({source or name: tracks for source, tracks in element.origins.items()})


def _in_box(element: MapElement, low: Float, high: Float) -> list[MapElement]:
    """Return the parts of a line inside a box, or a crossing as a whole if it touches the box."""
    if (element.points.max(axis=0) < low).any() or (element.points.min(axis=0) >= high).any():
        return []
    if element.kind.is_ring:
        return [element]
    told = {name: getattr(element, name) for name in ("deviation", "heights") if getattr(element, name) is not None}
    values = np.stack([*told.values()], axis=1) if told else np.zeros((len(element.points), 0))
    return [
        replace(element, points=points, **dict(zip(told, part.T, strict=True)))
        for points, part in cut_line(element.points, values, low, high)
    ]


def _owns(tile: Tile, ring: MapElement) -> bool:
    """Whether the middle of a crossing lies in a tile."""
    middle = (ring.points.min(axis=0) + ring.points.max(axis=0)) / 2
    return bool((middle >= tile.low).all() and (middle < tile.high).all())
