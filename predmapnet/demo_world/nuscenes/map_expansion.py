"""A vector map in the schema of the nuScenes map expansion, version 1.3, and as the picture called semantic prior."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import Polygon

from mapfusion.arrays import Float
from predmapnet.demo_world.nuscenes.tables import token
from predmapnet.demo_world.world import Divider, LineStyle, VectorMap

Record = dict[str, Any]

CANVAS_EDGE = (800.0, 800.0)
"""Width and height of the map, metres; every town lies inside."""

PRIOR_PIXELS_PER_METRE = 10
"""Fixed by the devkit."""

_SEGMENT_TYPES = {
    LineStyle.SOLID: "SINGLE_SOLID",
    LineStyle.DASHED: "SINGLE_DASHED",
    LineStyle.DOUBLE_SOLID: "DOUBLE_SOLID",
    LineStyle.SOLID_DASHED: "DOUBLE_SOLID",
    LineStyle.UNPAINTED: "NIL",
}


class _Sheet:
    """Collects nodes, lines and polygons, and hands out their tokens. Equal coordinates share a node."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.nodes: dict[tuple[float, float], Record] = {}
        self.lines: list[Record] = []
        self.polygons: list[Record] = []

    def token(self, layer: str, index: int) -> str:
        digits = token(self.name, "expansion", layer, index)
        return f"{digits[:8]}-{digits[8:12]}-{digits[12:16]}-{digits[16:20]}-{digits[20:]}"

    def node_tokens(self, points: Float) -> list[str]:
        for x, y in points.tolist():
            if (x, y) not in self.nodes:
                self.nodes[x, y] = {"token": self.token("node", len(self.nodes)), "x": x, "y": y}
        return [self.nodes[x, y]["token"] for x, y in points.tolist()]

    def line(self, points: Float) -> str:
        record = {"token": self.token("line", len(self.lines)), "node_tokens": self.node_tokens(points)}
        self.lines.append(record)
        return str(record["token"])

    def polygon(self, polygon: Polygon) -> str:
        record = {
            "token": self.token("polygon", len(self.polygons)),
            "exterior_node_tokens": self.node_tokens(_open_ring(polygon.exterior)),
            "holes": [{"node_tokens": self.node_tokens(_open_ring(ring))} for ring in polygon.interiors],
        }
        self.polygons.append(record)
        return str(record["token"])

    def polygon_layer(self, layer: str, polygons: Iterable[Polygon], **fields: Any) -> list[Record]:
        return [
            {"token": self.token(layer, index), "polygon_token": self.polygon(polygon), **fields}
            for index, polygon in enumerate(polygons)
        ]


def _open_ring(ring: shapely.LinearRing) -> Float:
    coordinates: Float = shapely.get_coordinates(ring)[:-1]
    return coordinates


def build_expansion(name: str, vector_map: VectorMap) -> dict[str, Any]:
    """Return the content of ``maps/expansion/<location>.json``; tokens depend on the name of the scene.

    Layers that a vector map knows nothing of (road blocks, lane connectors, traffic lights) are empty. All coordinates
    lie inside :data:`CANVAS_EDGE`.
    """
    sheet = _Sheet(name)
    segments = sheet.polygon_layer("road_segment", vector_map.road_segments)
    _mark_intersections(segments, vector_map)
    drivable = {
        "token": sheet.token("drivable_area", 0),
        "polygon_tokens": [segment["polygon_token"] for segment in segments],
    }
    for segment in segments:
        segment["drivable_area_token"] = drivable["token"]
    index = shapely.STRtree(vector_map.road_segments)

    def segment_at(geometry: shapely.Geometry) -> str:
        return str(segments[int(index.nearest(geometry.centroid))]["token"])

    crossings = sheet.polygon_layer("ped_crossing", (crossing.polygon for crossing in vector_map.crossings))
    for record, crossing in zip(crossings, vector_map.crossings, strict=True):
        record["road_segment_token"] = segment_at(crossing.polygon)
    layers = {
        "drivable_area": [drivable],
        "road_segment": segments,
        "road_block": [],
        "lane": [_lane(sheet, number, lane) for number, lane in enumerate(vector_map.lanes)],
        "ped_crossing": crossings,
        "walkway": sheet.polygon_layer("walkway", vector_map.walkways),
        "stop_line": sheet.polygon_layer(
            "stop_line",
            vector_map.stop_lines,
            stop_line_type="STOP_SIGN",
            ped_crossing_tokens=[],
            traffic_light_tokens=[],
            road_block_token="",
        ),
        "carpark_area": sheet.polygon_layer("carpark_area", vector_map.parking, orientation=0.0, road_block_token=""),
        "road_divider": [
            _road_divider(sheet, number, divider, segment_at(shapely.LineString(divider.points)))
            for number, divider in enumerate(divider for divider in vector_map.dividers if divider.opposite)
        ],
        "lane_divider": [
            _lane_divider(sheet, number, divider)
            for number, divider in enumerate(divider for divider in vector_map.dividers if not divider.opposite)
        ],
        "traffic_light": [],
        "lane_connector": [],
    }
    return {
        "version": "1.3",
        "canvas_edge": list(CANVAS_EDGE),
        "polygon": sheet.polygons,
        "line": sheet.lines,
        "node": list(sheet.nodes.values()),
        **layers,
        "arcline_path_3": {
            lane["token"]: _arcline_path(path)
            for lane, path in zip(layers["lane"], vector_map.lane_paths, strict=False)
        },
        "connectivity": {lane["token"]: {"incoming": [], "outgoing": []} for lane in layers["lane"]},
    }


def _mark_intersections(segments: list[Record], vector_map: VectorMap) -> None:
    """A segment that lanes hardly cover is a junction: lanes end where junctions begin."""
    shapes = np.array(vector_map.road_segments, dtype=object)
    covered = shapely.area(shapely.intersection(shapes, shapely.union_all(vector_map.lanes)))
    for segment, share in zip(segments, covered / shapely.area(shapes), strict=True):
        segment["is_intersection"] = bool(share < 0.4)


def _lane(sheet: _Sheet, index: int, lane: Polygon) -> Record:
    return {
        "token": sheet.token("lane", index),
        "polygon_token": sheet.polygon(lane),
        "lane_type": "CAR",
        "from_edge_line_token": "",
        "to_edge_line_token": "",
        "left_lane_divider_segments": [],
        "right_lane_divider_segments": [],
    }


def _arcline_path(path: Float) -> list[Record]:
    """A lane path as straight pieces of the devkit's arc-line-arc primitive, within 3 cm of the path."""
    corners = shapely.get_coordinates(shapely.LineString(path).simplify(0.03))
    steps = np.diff(corners, axis=0)
    lengths, headings = np.linalg.norm(steps, axis=1).tolist(), np.arctan2(steps[:, 1], steps[:, 0]).tolist()
    return [
        {
            "start_pose": [*start, heading],
            "end_pose": [*end, heading],
            "shape": "LSL",
            "radius": 999.999,
            "segment_length": [0.0, length, 0.0],
        }
        for start, end, heading, length in zip(
            corners[:-1].tolist(), corners[1:].tolist(), headings, lengths, strict=True
        )
    ]


def _road_divider(sheet: _Sheet, index: int, divider: Divider, segment_token: str) -> Record:
    return {
        "token": sheet.token("road_divider", index),
        "line_token": sheet.line(divider.points),
        "road_segment_token": segment_token,
    }


def _lane_divider(sheet: _Sheet, index: int, divider: Divider) -> Record:
    paint = _SEGMENT_TYPES[divider.style]
    segment_type = paint if paint == "NIL" else f"{paint}_{divider.colour.upper()}"
    return {
        "token": sheet.token("lane_divider", index),
        "line_token": sheet.line(divider.points),
        "lane_divider_segments": [
            {"node_token": node, "segment_type": segment_type} for node in sheet.node_tokens(divider.points)
        ],
    }


def draw_prior(vector_map: VectorMap) -> NDArray[np.uint8]:
    """The semantic prior: 255 where cars or people go, ``(rows, columns)``, 0.1 m per pixel, row 0 in the north."""
    width, height = (round(edge * PRIOR_PIXELS_PER_METRE) for edge in CANVAS_EDGE)
    prior = np.zeros((height, width), dtype=np.uint8)
    for polygon in vector_map.road_segments + vector_map.walkways:
        rings = [shapely.get_coordinates(ring) for ring in (polygon.exterior, *polygon.interiors)]
        pixels = [np.rint((ring * [1, -1] + [0, CANVAS_EDGE[1]]) * PRIOR_PIXELS_PER_METRE) for ring in rings]
        cv2.fillPoly(prior, [ring.astype(np.int32) for ring in pixels], 255)
    return prior
