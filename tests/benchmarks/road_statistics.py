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
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely import LineString, Polygon

from mapfusion.arrays import Float
from predmapnet.datasets.ground_truth.map_file import read_map_file
from predmapnet.demo_world.catalogue import FIRST_SPLITS, vector_map
from predmapnet.demo_world.first_towns import first_town
from predmapnet.demo_world.world import Crossing, CrossingStyle, Divider, LineStyle, VectorMap
from tests.real_roads.argoverse_logs import vector_map_of

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


def argoverse_map(path: Path) -> VectorMap:
    """A map of Argoverse 2, with the lanes of cars outside junctions and their centre lines."""
    content = read_map_file(path)[0]
    lanes, paths = [], []
    for lane in content["lane_segments"].values():
        sides = [
            LineString([(place["x"], place["y"]) for place in lane[f"{side}_lane_boundary"]])
            for side in ("left", "right")
        ]
        outline = Polygon([*sides[0].coords, *reversed(sides[1].coords)])
        if lane["is_intersection"] or lane["lane_type"] == "BIKE" or not outline.is_valid:
            continue
        left, right = (shapely.line_interpolate_point(side, np.linspace(0, 1, 12), normalized=True) for side in sides)
        lanes.append(outline)
        paths.append((shapely.get_coordinates(left) + shapely.get_coordinates(right)) / 2)
    return replace(vector_map_of(content), lanes=tuple(lanes), lane_paths=tuple(paths))


def crossing_row(maps: list[VectorMap], roads: list[shapely.Geometry]) -> Row:
    """Measures of crossings: how they meet, how long, deep and skewed they are, how many."""
    touching: list[bool] = []
    on_curve: list[bool] = []
    lengths, depths, fill, off, gaps, aslant = [], [], [], [], [], []
    for town, road in zip(maps, roads, strict=True):
        shapes = [crossing.polygon for crossing in town.crossings]
        paths = shapely.STRtree([LineString(path) for path in town.lane_paths])
        for index, shape in enumerate(shapes):
            others = shapes[:index] + shapes[index + 1 :]
            gap = min((shape.distance(other) for other in others), default=np.inf)
            touching.append(gap < 0.5)
            gaps += [gap] if others else []
            box = np.asarray(shape.minimum_rotated_rectangle.exterior.coords)
            sides = sorted(np.linalg.norm(np.diff(box[:3], axis=0), axis=1).tolist())
            depths.append(sides[0])
            lengths.append(sides[1])
            fill.append(100 * shape.area / (sides[0] * sides[1]))
            off.append(100 * shape.difference(road).area / shape.area)
            on_curve += _ends_on_curve(box, road)
            aslant += _off_square(shape, box, paths)
    area = sum(road.area for road in roads) / 1e4
    return {
        "crossings touching another (< 0.5 m), %": share(touching),
        "crossing ends on a curved kerb, %": share(on_curve),
        "crossing length p10/50/90, m": percentiles(lengths),
        "crossing depth p10/50/90, m": percentiles(depths),
        "crossing off square to the nearest lane p50/90, degrees": _two(aslant),
        "gap to the next crossing, median, m": f"{np.median(gaps):.1f}" if gaps else "-",
        "crossing area / its rectangle, median, %": f"{np.median(fill):.0f}" if fill else "-",
        "crossing area off the road, median, %": f"{np.median(off):.0f}" if off else "-",
        "crossings per hectare of road": f"{len(lengths) / area:.1f}",
    }


def _two(values: list[float]) -> str:
    return "/".join(f"{value:.1f}" for value in np.percentile(values, [50, 90])) if values else "-"


def _off_square(shape: Polygon, box: Float, paths: shapely.STRtree) -> list[float]:
    """Angle between a crossing's longer axis and the normal of the lane nearest to it, degrees; none beyond 15 m."""
    near = paths.query_nearest(shape.centroid, max_distance=15.0, all_matches=False)
    if not len(near):
        return []
    path = paths.geometries[near[0]]
    at = min(max(path.project(shape.centroid), 1.0), path.length - 1.0)
    first, last = np.diff(box[:3], axis=0)
    along = first if np.linalg.norm(first) > np.linalg.norm(last) else last
    angle = abs(float(np.arctan2(along[1], along[0])) - _heading(path, at)) % np.pi
    return [abs(90.0 - float(np.degrees(angle)))]


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
        "lane paths with a radius under 200 m, %": f"{weighted:.0f}" if tight else "-",
    }


def street_row(maps: list[VectorMap], roads: list[shapely.Geometry]) -> Row:
    """Measures of streets, looked at across a lane every 20 m: lanes each way, medians; lanes that open or close."""
    same, opposite, medians = [], [], []
    ends, length = 0, 0.0
    for town, road in zip(maps, roads, strict=True):
        shapely.prepare(road)
        lines = [LineString(path) for path in town.lane_paths]
        tree, lanes = shapely.STRtree(lines), shapely.STRtree(town.lanes)
        for line in lines:
            length += line.length / 1000
            ends += sum(_narrow(lanes, line, at) for at in (1.0, line.length - 1.0) if line.length > 12.0)
            for at in np.arange(10.0, line.length - 5.0, 20.0):
                ahead, against, between = _across(line, at, lines, tree)
                same.append(ahead)
                opposite.append(against)
                if between is not None:
                    free = between.difference(shapely.union_all([town.lanes[row] for row in lanes.query(between)]))
                    medians.append("" if free.length < 0.4 else ("paint" if road.covers(free) else "raised"))
    counts, others = np.array(same), np.array(opposite)
    if not same:
        return dict.fromkeys(STREET_MEASURES, "-")
    two_way = others > 0
    values = (
        "/".join(f"{100 * np.mean(counts == n if n < 4 else counts > 3):.0f}" for n in (1, 2, 3, 4)),
        f"{100 * np.mean(~two_way):.0f}",
        f"{100 * np.mean(counts[two_way] != others[two_way]):.0f}" if two_way.any() else "-",
        f"{ends / length:.1f}",
        " / ".join(share([median == kind for median in medians]) for kind in ("raised", "paint")),
    )
    return dict(zip(STREET_MEASURES, values, strict=True))


STREET_MEASURES = (
    "lanes per direction 1/2/3/4+, %",
    "one-way, %",
    "unequal lanes per direction where two-way, %",
    "lanes that open or close (an end under 1.8 m wide) per lane km",
    "raised median / painted gap between directions, %",
)


def _normal(line: LineString, at: float, reach: float) -> tuple[LineString, Float]:
    """A straight across a line, and the direction of the line there."""
    heading = _heading(line, at)
    ahead = np.array([np.cos(heading), np.sin(heading)])
    here = shapely.get_coordinates(line.interpolate(at))[0]
    aside = reach * np.array([-ahead[1], ahead[0]])
    return LineString([here - aside, here + aside]), ahead


def _narrow(lanes: shapely.STRtree, line: LineString, at: float) -> bool:
    """Whether the widest lane that holds a place of a lane path is under 1.8 m wide there; False where none does."""
    cut = _normal(line, at, 4.0)[0]
    holding = lanes.geometries[lanes.query(line.interpolate(at), predicate="within")]
    return bool(len(holding) and shapely.length(shapely.intersection(holding, cut)).max() < 1.8)


def _across(
    line: LineString, at: float, lines: list[LineString], tree: shapely.STRtree
) -> tuple[int, int, LineString | None]:
    """Lanes beside a place of a lane in its own and in the other direction, and the way between the directions."""
    cut, ahead = _normal(line, at, 25.0)
    found: list[tuple[float, bool]] = []
    for row in tree.query(cut, predicate="intersects"):
        for place in shapely.get_parts(cut.intersection(lines[row])):
            if place.geom_type == "Point":
                other = _normal(lines[row], lines[row].project(place), 1.0)[1]
                if abs(other @ ahead) > 0.94:
                    found.append((cut.project(place), bool(other @ ahead > 0)))
    found.sort()
    here = min(range(len(found)), key=lambda index: abs(found[index][0] - 25.0))
    first = last = here
    # Neighbours lie within 8 m: a lane and a median.
    while first > 0 and found[first][0] - found[first - 1][0] < 8.0:
        first -= 1
    while last + 1 < len(found) and found[last + 1][0] - found[last][0] < 8.0:
        last += 1
    street = found[first : last + 1]
    turns = [(a, b) for (a, ahead_a), (b, ahead_b) in pairwise(street) if ahead_a != ahead_b]
    between = None
    if len(turns) == 1:
        between = LineString([cut.interpolate(station) for station in turns[0]])
    count = sum(is_ahead for _, is_ahead in street)
    return count, len(street) - count, between


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
    return crossing_row(maps, roads) | street_row(maps, roads) | lane_row(maps) | paint_row(maps) | kerb_row(roads)


def sources(towns: int) -> Iterator[tuple[str, Callable[[], list[VectorMap]]]]:
    """Names of the sources that are there, and how to read them."""
    root = Path(os.environ.get("PREDMAPNET_REFERENCE", Path(__file__).parents[3] / "shared/reference/public"))
    yield "new towns", lambda: [vector_map(f"scene-{number:04d}") for number in range(201, 201 + towns)]
    yield "old towns", lambda: [first_town(number)[0] for number in FIRST_SPLITS["test"]]
    archives = sorted((root / "ground_truth/av2/logs").glob("*/map/log_map_archive_*.json"))
    if archives:
        yield "Argoverse 2", lambda: [argoverse_map(path) for path in archives]
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
