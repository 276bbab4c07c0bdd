"""Road statistics: our towns beside real maps, in the terms of a table.

Run ``python -m tests.benchmarks.road_statistics [--towns N]``. The measures are rough but the same for all sources:
lanes are measured across their paths, crossings by their outlines, kerbs by the rim of the united road surface.
Argoverse 2 logs and the free maps are read from ``$PREDMAPNET_REFERENCE``; what is absent is left out.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import LineString, Polygon

from predmapnet.datasets.ground_truth.map_file import read_map
from predmapnet.demo_world.av2_dressing import vector_map_of
from predmapnet.demo_world.catalogue import vector_map
from predmapnet.demo_world.town_v1.town import build_town as build_first_town
from predmapnet.demo_world.world import Crossing, CrossingStyle, Divider, LineStyle, VectorMap

Float = NDArray[np.float64]
Row = dict[str, str]


def percentiles(values: list[float], digits: int = 1) -> str:
    """Tenth, fiftieth and ninetieth percentile, as text."""
    if not values:
        return "-"
    return "/".join(f"{value:.{digits}f}" for value in np.percentile(values, [10, 50, 90]))


def share(values: list[bool]) -> str:
    """Share of True in percent, as text."""
    return f"{100 * float(np.mean(values)):.0f}" if values else "-"


def free_map(path: Path) -> VectorMap:
    """A map of ``road_geometry`` in the demo world's terms."""
    content: dict[str, Any] = json.loads(path.read_text())
    dividers = tuple(
        Divider(np.array(line["points"]), LineStyle(line["style"]), line["colour"], bool(line.get("opposite")))
        for line in content["dividers"]
        if not line.get("edge")
    )
    edges = tuple(
        Divider(np.array(line["points"]), LineStyle(line["style"]), line["colour"])
        for line in content["dividers"]
        if line.get("edge")
    )
    return VectorMap(
        tuple(Polygon(part["exterior"], part["holes"]) for part in content["road_segments"]),
        tuple(Polygon(ring) for ring in content["lanes"]),
        tuple(Crossing(Polygon(ring), CrossingStyle.ZEBRA, 0.0) for ring in content["crossings"]),
        dividers,
        lane_paths=tuple(np.array(line) for line in content["lane_paths"]),
        markings=edges,
    )


def crossing_row(maps: list[VectorMap], roads: list[shapely.Geometry]) -> Row:
    """Measures of crossings: how they meet, how long, deep and skewed they are, how many."""
    touching: list[bool] = []
    on_curve: list[bool] = []
    lengths, depths, fill, off = [], [], [], []
    for town, road in zip(maps, roads, strict=True):
        shapes = [crossing.polygon for crossing in town.crossings]
        for index, shape in enumerate(shapes):
            others = shapes[:index] + shapes[index + 1 :]
            touching.append(min((shape.distance(other) for other in others), default=99.0) < 0.5)
            box = np.asarray(shape.minimum_rotated_rectangle.exterior.coords)
            sides = sorted(np.linalg.norm(np.diff(box[:3], axis=0), axis=1).tolist())
            depths.append(sides[0])
            lengths.append(sides[1])
            fill.append(100 * shape.area / (sides[0] * sides[1]))
            off.append(100 * shape.difference(road).area / shape.area)
            on_curve += _ends_on_curve(box, road)
    area = sum(road.area for road in roads) / 1e4
    return {
        "crossings touching another (< 0.5 m), %": share(touching),
        "crossing ends on a curved kerb, %": share(on_curve),
        "crossing length p10/50/90, m": percentiles(lengths),
        "crossing depth p10/50/90, m": percentiles(depths),
        "crossing area / its rectangle, median, %": f"{np.median(fill):.0f}" if fill else "-",
        "crossing area off the road, median, %": f"{np.median(off):.0f}" if off else "-",
        "crossings per hectare of road": f"{len(lengths) / area:.1f}",
    }


def _ends_on_curve(box: Float, road: shapely.Geometry) -> list[bool]:
    """Whether the kerb turns by more than 8 degrees within 4 m of each end of a crossing."""
    if np.linalg.norm(box[1] - box[0]) > np.linalg.norm(box[2] - box[1]):
        box = np.roll(box[:4], -1, axis=0)
    found = []
    for end in ((box[0] + box[1]) / 2, (box[2] + box[3]) / 2):
        near = shapely.Point(end).buffer(4.0)
        rim = [part for part in shapely.get_parts(road.boundary.intersection(near)) if part.length > 2.0]
        turns = []
        for part in rim:
            steps = np.diff(shapely.get_coordinates(part.simplify(0.05)), axis=0)
            headings = np.arctan2(steps[:, 1], steps[:, 0])
            turns.append(abs(float(np.angle(np.exp(1j * (headings[-1] - headings[0]))))))
        found.append(max(turns, default=0.0) > np.radians(8.0))
    return found


def lane_row(maps: list[VectorMap]) -> Row:
    """Measures of lanes: how wide and how straight they are."""
    widths, tight, lengths = [], [], []
    for town in maps:
        for lane in town.lanes:
            box = lane.minimum_rotated_rectangle
            if lane.area > 20.0 and box.area > 0:
                perimeter = lane.length / 2
                long = (perimeter + np.sqrt(max(perimeter**2 - 4 * lane.area, 0.0))) / 2
                if long > 8.0:
                    widths.append(float(lane.area / long))
        for path in town.lane_paths or [divider.points for divider in town.dividers]:
            line = shapely.segmentize(LineString(path).simplify(0.1), 5.0)
            points = shapely.get_coordinates(shapely.line_interpolate_point(line, np.arange(0, line.length, 8.0)))
            if len(points) < 4:
                continue
            steps = np.diff(points, axis=0)
            bend = np.abs(np.angle(np.exp(1j * np.diff(np.arctan2(steps[:, 1], steps[:, 0])))))
            tight.append(float(np.median(bend)) / 8.0 > 1 / 200)
            lengths.append(line.length)
    weighted = 100 * float(np.average(tight, weights=lengths)) if tight else np.nan
    return {
        "lane width p10/50/90 (deviation), m": f"{percentiles(widths)} ({np.std(widths):.2f})" if widths else "-",
        "lane paths with a radius under 200 m, %": f"{weighted:.0f}",
    }


def paint_row(maps: list[VectorMap]) -> Row:
    """Measures of lines: colour, style, how long, how parallel, where they end."""
    by_style: dict[str, float] = {}
    lengths, gaps = [], []
    yellow = total = edge = 0.0
    aslant: list[float] = []
    for town in maps:
        lines = [LineString(divider.points) for divider in town.dividers]
        for divider, line in zip(town.dividers, lines, strict=True):
            total += line.length
            lengths.append(line.length)
            yellow += line.length * (divider.colour == "yellow")
            by_style[divider.style] = by_style.get(divider.style, 0.0) + line.length
        edge += sum(LineString(marking.points).length for marking in town.markings)
        aslant += _angles_of_neighbours(lines)
        if town.crossings:
            crossings = shapely.union_all([crossing.polygon for crossing in town.crossings])
            ends = [shapely.Point(divider.points[end]) for divider in town.dividers for end in (0, -1)]
            gaps += [gap for gap in shapely.distance(ends, crossings).tolist() if gap < 40.0]
    part = {style: 100 * length / max(total, 1e-9) for style, length in by_style.items()}
    double = part.get("double_solid", 0.0) + part.get("solid_dashed", 0.0)
    return {
        "neighbouring dividers more than 2 / 5 degrees off parallel, %": (
            f"{share([a > 2 for a in aslant])} / {share([a > 5 for a in aslant])}"
        ),
        "yellow share of divider length, %": f"{100 * yellow / max(total, 1e-9):.0f}",
        "solid / dashed / double, %": f"{part.get('solid', 0):.0f}/{part.get('dashed', 0):.0f}/{double:.0f}",
        "dividers without paint, %": f"{part.get('unpainted', 0):.1f}",
        "lines that divide no lanes, per length of dividers, %": f"{100 * edge / max(total, 1e-9):.0f}",
        "divider end to the nearest crossing, median, m": f"{np.median(gaps):.1f}" if gaps else "-",
        "divider length p10/50/90, m": percentiles(lengths, 0),
    }


def _angles_of_neighbours(lines: list[LineString]) -> list[float]:
    """Angle to the nearest line within 6 m at places 5 m apart, degrees; lines that cross at over 30 do not count."""
    if len(lines) < 2:
        return []
    tree = shapely.STRtree(lines)
    found = []
    for index, line in enumerate(lines):
        for at in np.arange(2.5, line.length - 2.5, 5.0):
            here = line.interpolate(at)
            near = [row for row in tree.query(here.buffer(6.0), predicate="intersects") if row != index]
            if not near:
                continue
            other = lines[min(near, key=lambda row: lines[row].distance(here))]
            there = other.project(here)
            if not 1.0 < there < other.length - 1.0:
                continue
            angle = abs(_heading(line, at) - _heading(other, there)) % np.pi
            angle = float(np.degrees(min(angle, np.pi - angle)))
            if angle < 30.0:
                found.append(angle)
    return found


def _heading(line: LineString, at: float) -> float:
    first, last = line.interpolate(max(at - 1.0, 0.0)), line.interpolate(min(at + 1.0, line.length))
    return float(np.arctan2(last.y - first.y, last.x - first.x))


def kerb_row(roads: list[shapely.Geometry]) -> Row:
    """Measures of kerbs: straightness, openings (narrow stubs of the surface), islands."""
    straight = total = openings = islands = 0.0
    for road in roads:
        for polygon in shapely.get_parts(road):
            for ring in (polygon.exterior, *polygon.interiors):
                points = shapely.get_coordinates(LineString(ring.coords).simplify(0.1))
                steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
                straight += float(steps[steps > 8.0].sum())
                total += float(steps.sum())
            islands += sum(Polygon(ring).area < 600.0 for ring in polygon.interiors)
        # A stub that is narrower than 9 m disappears when the surface is opened by 4.5 m.
        opened = road.buffer(-4.5).buffer(4.6)
        stubs = [part for part in shapely.get_parts(road.difference(opened)) if 8.0 < part.area < 160.0]
        openings += len(stubs)
    area = sum(road.area for road in roads) / 1e4
    return {
        "kerb in straight pieces over 8 m, %": f"{100 * straight / total:.0f}",
        "narrow stubs (openings) per 100 m of kerb": f"{100 * openings / total:.2f}",
        "islands per hectare of road": f"{islands / area:.1f}",
    }


def measure(maps: list[VectorMap]) -> Row:
    """All measures of some maps."""
    roads = [shapely.union_all([part.buffer(0.02, join_style="mitre") for part in town.road_segments]) for town in maps]
    return crossing_row(maps, roads) | lane_row(maps) | paint_row(maps) | kerb_row(roads)


def sources(towns: int) -> Iterator[tuple[str, Callable[[], list[VectorMap]]]]:
    """Names of the sources that are there, and how to read them."""
    root = Path(os.environ.get("PREDMAPNET_REFERENCE", Path(__file__).parents[3] / "shared/reference/public"))
    yield "new towns", lambda: [vector_map(f"scene-{number:04d}") for number in range(201, 201 + towns)]
    yield "old towns", lambda: [build_first_town(number).vector_map for number in range(201, 201 + towns)]
    archives = sorted((root / "ground_truth/av2/logs").glob("*/map/log_map_archive_*.json"))
    if archives:
        yield "Argoverse 2", lambda: [vector_map_of(read_map(path)[0]) for path in archives]
    for folder, kinds in (("check", ("*",)), ("train", ("carla*", "cambridge*"))):
        for kind in kinds:
            files = sorted((root / "road_geometry" / folder).glob(f"{kind}.json"))
            for group in [files] if kind != "*" else [[path] for path in files]:
                if group:
                    name = group[0].stem if kind == "*" else kind.rstrip("*")
                    yield name, lambda group=group: [free_map(path) for path in group]  # type: ignore[misc]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--towns", type=int, default=20, help="how many towns of each world are measured")
    options = parser.parse_args()
    columns = {name: measure(read()) for name, read in sources(options.towns)}
    print("| | " + " | ".join(columns) + " |")
    print("|---" * (len(columns) + 1) + "|")
    for measure_name in next(iter(columns.values())):
        print(f"| {measure_name} | " + " | ".join(column[measure_name] for column in columns.values()) + " |")


if __name__ == "__main__":
    main()
