"""The ten test towns of the first world: maps and drives, kept so that new networks can be measured on them.

``first_towns.json.xz`` holds what the first town generator drew for the seeds 101 to 110, in millimetres; each point
is told as the step from the one before it.
"""

from __future__ import annotations

import json
import lzma
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from shapely import Polygon

from mapfusion.arrays import Float
from predmapnet.demo_world.world import Crossing, CrossingStyle, Divider, LineStyle, Trajectory, VectorMap


def first_town(number: int) -> tuple[VectorMap, Trajectory]:
    """Return the map and the drive of a scene of the first world, 101 to 110."""
    town = _towns()[str(number)]
    vector_map = VectorMap(
        road_segments=_polygons(town["road_segments"]),
        lanes=_polygons(town["lanes"]),
        crossings=tuple(
            Crossing(_polygon(crossing["polygon"]), CrossingStyle(crossing["style"]), crossing["heading"])
            for crossing in town["crossings"]
        ),
        dividers=tuple(
            Divider(_points(line["points"]), LineStyle(line["style"]), line["colour"], line["opposite"])
            for line in town["dividers"]
        ),
        walkways=_polygons(town["walkways"]),
        parking=_polygons(town["parking"]),
        stop_lines=_polygons(town["stop_lines"]),
        lane_paths=tuple(map(_points, town["lane_paths"])),
    )
    return vector_map, Trajectory(np.array(town["timestamps"], dtype=np.int64), np.array(town["ego_to_global"]))


@cache
def _towns() -> dict[str, Any]:
    content: dict[str, Any] = json.loads(lzma.decompress(Path(__file__).with_suffix(".json.xz").read_bytes()))
    return content


def _points(steps: list[list[int]]) -> Float:
    """Points ``(n, 2)``, metres."""
    points: Float = np.cumsum(steps, axis=0) / 1000
    return points


def _polygon(rings: list[list[list[int]]]) -> Polygon:
    outer, *holes = map(_points, rings)
    return Polygon(outer, holes)


def _polygons(polygons: list[list[list[list[int]]]]) -> tuple[Polygon, ...]:
    return tuple(map(_polygon, polygons))
