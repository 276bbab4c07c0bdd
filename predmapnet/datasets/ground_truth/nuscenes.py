"""Ground truth from a nuScenes map expansion (v1.3), frame by frame as the official vector-map code forms it."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely import LineString, Polygon, STRtree

from mapfusion.arrays import Float
from mapfusion.elements import ElementKind, RegionOfInterest
from mapfusion.geometry import FARTHEST_POSE, rotation_of_quaternion
from predmapnet.datasets.ground_truth.crossings import MINIMUM_AREA, merge_crossings
from predmapnet.datasets.ground_truth.map_file import MALFORMED, read_map_file
from predmapnet.datasets.ground_truth.patch import (
    BORDER,
    apply,
    area_rings,
    crossing_contours,
    cut_rings,
    midpoint,
    nearest_rows,
    parts_of_type,
    patch_polygon,
    restored_corners,
    rotation_about,
)
from predmapnet.datasets.poses import quaternion_of
from predmapnet.errors import UserError
from predmapnet.scenes import FrameTruth


class NuScenesGroundTruth:
    """One map of nuScenes: the ground truth around any pose.

    Geometry is indexed once; a frame touches only what lies near it.

    Attributes:
        dividers: road dividers, then lane dividers, in file order (empty lines stay, for their index).
        crossings: pieces of pedestrian crossings in file order.
        road_segments, lanes: drivable surface in file order.
        fingerprint: digest of all that this was made from.
        keep_corners: whether crossings over a corner of the region keep it.
    """

    def __init__(self, map_file: Path | Mapping[str, Any], keep_corners: bool = False) -> None:
        """Read a map.

        Args:
            map_file: ``maps/expansion/<location>.json``, or its content.
            keep_corners: False does as the official code, in which a crossing that lies over a corner of the region
                loses that corner in some frames, by the last bits of the pose; True keeps all corners.

        Raises:
            UserError: the file is missing, damaged, or not a map expansion.
        """
        content, digest = read_map_file(map_file)
        self.keep_corners = keep_corners
        self.fingerprint = digest + bytes([keep_corners])
        name = "the map" if isinstance(map_file, Mapping) else str(map_file)
        if not isinstance(map_file, Mapping):
            check_version(content, name)
        try:
            nodes = _positions(content["node"])
            lines = {line["token"]: line["node_tokens"] for line in content["line"]}
            polygons = {polygon["token"]: polygon for polygon in content["polygon"]}
            self._index(
                dividers=[
                    _line([nodes[token] for token in lines[record["line_token"]]])
                    for layer in ("road_divider", "lane_divider")
                    for record in content[layer]
                ],
                crossings=_polygons(content["ped_crossing"], polygons, nodes),
                road_segments=_polygons(content["road_segment"], polygons, nodes),
                lanes=_polygons(content["lane"], polygons, nodes),
            )
        except MALFORMED as error:
            raise UserError(
                f"{name} is not a nuScenes map expansion of version 1.3 ({type(error).__name__}: {error}). "
                "Fetch the map expansion again and unpack it into maps/expansion."
            ) from None

    @classmethod
    def from_layers(
        cls, dividers: list[LineString], crossings: list[Polygon], road_segments: list[Polygon], lanes: list[Polygon]
    ) -> NuScenesGroundTruth:
        """Take the layers of a map that is no file; no official figures depend on it, so crossings keep their corners.

        ``dividers`` are road dividers, then lane dividers; segments and lanes are drivable surface. Global frame.
        """
        truth = cls.__new__(cls)
        truth.keep_corners = True
        truth._index(dividers, crossings, road_segments, lanes)
        layers = (dividers, crossings, road_segments, lanes)
        truth.fingerprint = hashlib.sha256(
            b"".join(shapely.to_wkb(shapely.geometrycollections(layer)) for layer in layers)
        ).digest()
        return truth

    def _index(
        self,
        dividers: list[LineString],
        crossings: list[Polygon],
        road_segments: list[Polygon],
        lanes: list[Polygon],
    ) -> None:
        self.dividers, self.crossings = dividers, crossings
        self.road_segments, self.lanes = road_segments, lanes
        self._layers = {
            "dividers": _Layer(dividers),
            "crossings": _Layer(crossings),
            "road_segments": _Layer(road_segments),
            "lanes": _Layer(lanes),
        }

    def frame(self, lidar_to_global: Float, roi: RegionOfInterest) -> FrameTruth:
        """Return the truth of a region around one lidar pose ``(4, 4)``: crossings, dividers, boundaries in this order.

        x is forward, y left of the lidar, of whose pose (x right, y forward) only x, y and yaw matter. Pieces of the
        same source element carry the same id.
        """
        centre = (float(lidar_to_global[0, 3]), float(lidar_to_global[1, 3]))
        # The official code hands the pose on as a quaternion; its last bits decide about corners of crossings.
        rotation = rotation_of_quaternion(quaternion_of(lidar_to_global[:3, :3]))
        angle = math.atan2(rotation[1, 0], rotation[0, 0]) / math.pi * 180
        patch = patch_polygon(centre, roi.width, roi.length, angle)
        place = _Place(centre, rotation_about(-angle, centre))
        box = shapely.box(-roi.width / 2, -roi.length / 2, roi.width / 2, roi.length / 2)
        inner = shapely.box(
            -roi.width / 2 + BORDER, -roi.length / 2 + BORDER, roi.width / 2 - BORDER, roi.length / 2 - BORDER
        )

        crossings, crossing_ids = self._crossings(patch, place, box)
        dividers, divider_ids = self._layers["dividers"].cut(patch, "LineString", place)
        divider_lines = [shapely.get_coordinates(line) for line in dividers]
        boundaries = self._boundaries(patch, place, inner)
        boundary_ids = nearest_rows(self._ring_tree, [place.to_global(midpoint(line)[None])[0] for line in boundaries])
        groups = (crossings, divider_lines, boundaries)
        return FrameTruth(
            kinds=np.repeat([kind.value for kind in ElementKind], [len(group) for group in groups]).astype(np.int64),
            # Clipping is done in the lidar's axes (x right, y forward); the last step turns to x forward, y left.
            polylines=tuple(apply(_TO_FORWARD_LEFT, line) for group in groups for line in group),
            element_ids=np.array([*crossing_ids, *divider_ids, *boundary_ids], dtype=np.int64),
        )

    def region(self, lidar_to_global: Float, roi: RegionOfInterest) -> Polygon:
        """Return the rectangle that a frame covers, in the global frame."""
        angle = math.degrees(math.atan2(lidar_to_global[1, 0], lidar_to_global[0, 0]))
        return patch_polygon(lidar_to_global[:2, 3], roi.width, roi.length, angle)

    def elements_within(self, area: Any) -> list[tuple[ElementKind, Float]]:
        """Return kind and points of whole elements (crossings merged, boundaries of the union) cut by an area."""
        everywhere = _Place((0.0, 0.0), rotation_about(0.0, (0.0, 0.0)))
        near = self._layers["crossings"].touching(area)
        merged = shapely.intersection(np.asarray(merge_crossings(near), dtype=object), area)
        crossings, _ = parts_of_type(merged, "Polygon")
        dividers, _ = self._layers["dividers"].cut(area, "LineString", everywhere)
        boundaries = cut_rings(self.rings, area) if self.rings else []
        return [
            *(
                (ElementKind.PED_CROSSING, shapely.get_coordinates(polygon.exterior))
                for polygon in crossings
                if polygon.area >= MINIMUM_AREA
            ),
            *((ElementKind.DIVIDER, shapely.get_coordinates(line)) for line in dividers),
            *((ElementKind.BOUNDARY, line) for line in boundaries),
        ]

    def _crossings(self, patch: Polygon, place: _Place, box: Polygon) -> tuple[list[Float], list[int]]:
        pieces, records = self._layers["crossings"].cut(patch, "Polygon", place)
        valid = shapely.is_valid(np.asarray(pieces, dtype=object))
        pieces = [piece for piece, good in zip(pieces, valid, strict=True) if good]
        records = [record for record, good in zip(records, valid, strict=True) if good]
        contours, ids = [], []
        merged = merge_crossings(pieces)
        insides = shapely.point_on_surface(np.asarray(pieces, dtype=object))
        outlines = crossing_contours(merged, box)
        if self.keep_corners:
            outlines = restored_corners(merged, outlines, box)
        for polygon, contour in zip(merged, outlines, strict=True):
            if contour is not None:
                contours.append(contour)
                members = np.flatnonzero(shapely.dwithin(polygon, insides, 1e-6))
                ids.append(min((records[member] for member in members), default=-1))
        return contours, ids

    def _boundaries(self, patch: Polygon, place: _Place, inner: Polygon) -> list[Float]:
        segments, _ = self._layers["road_segments"].cut(patch, "Polygon", place)
        lanes, _ = self._layers["lanes"].cut(patch, "Polygon", place)
        area = shapely.union(shapely.union_all(segments), shapely.union_all(lanes))
        rings = area_rings(area)
        return cut_rings(rings, inner) if rings else []

    @cached_property
    def rings(self) -> list[LineString]:
        """Rings of the drivable surface of the whole map, drivable side on the right hand, global frame."""
        return area_rings(shapely.union_all([*self._layers["road_segments"].valid, *self._layers["lanes"].valid]))

    @cached_property
    def _ring_tree(self) -> STRtree:
        return STRtree(self.rings)


_TO_FORWARD_LEFT = rotation_about(-90, (0.0, 0.0))


class _Place:
    """From the global frame to the lidar-aligned one, in the official order: turn about the centre, then shift."""

    def __init__(self, centre: tuple[float, float], turn: Float) -> None:
        self._centre = np.array(centre)
        self._turn = turn

    def to_local(self, points: Float) -> Float:
        return np.asarray(apply(self._turn, points) - self._centre)

    def to_global(self, points: Float) -> Float:
        return np.asarray(points @ self._turn[:, :2] + self._centre)


def check_version(content: Mapping[str, Any], name: str) -> None:
    """Raise UserError for a map expansion below 1.3, as the devkit does: its maps lie elsewhere, or lack layers."""
    version = str(content.get("version", "1.0"))
    if re.fullmatch(r"\d+(\.\d+)*", version) is None or tuple(map(int, version.split("."))) < (1, 3):
        found = f"version {version}" if "version" in content else "no version"
        raise UserError(
            f"{name} is an outdated map expansion ({found}); version 1.3 is expected. Fetch the map expansion again "
            "from nuscenes.org and unpack it into maps/expansion."
        )


class _Layer:
    """Geometries of one map layer with their spatial index; invalid ones are never found."""

    def __init__(self, geometries: Sequence[Any]) -> None:
        self._all = np.asarray(geometries, dtype=object)
        self._rows = np.flatnonzero(shapely.is_valid(self._all) & ~shapely.is_empty(self._all))
        self.valid = self._all[self._rows]
        self._tree = STRtree(self.valid)

    def touching(self, area: Any) -> list[Any]:
        """Geometries that meet an area, whole, in file order."""
        return list(self.valid[np.sort(self._tree.query(area, predicate="intersects"))])

    def cut(self, patch: Polygon, part_type: str, place: _Place) -> tuple[list[Any], list[int]]:
        """Intersect with the patch and bring the parts to the local frame; also the index of each part's record."""
        near = np.sort(self._tree.query(patch, predicate="intersects"))
        parts, index = parts_of_type(shapely.intersection(self.valid[near], patch), part_type)
        records = [int(self._rows[near[row]]) for row in index]
        return list(shapely.transform(np.asarray(parts, dtype=object), place.to_local)), records


def _polygons(
    records: Iterable[Mapping[str, Any]], polygons: Mapping[str, Any], nodes: Mapping[str, tuple[float, float]]
) -> list[Polygon]:
    result = []
    for record in records:
        polygon = polygons[record["polygon_token"]]
        holes = [[nodes[token] for token in hole["node_tokens"]] for hole in polygon["holes"]]
        exterior = [nodes[token] for token in polygon["exterior_node_tokens"]]
        if len(exterior) < 3:
            result.append(Polygon())
            continue
        result.append(Polygon(exterior, [hole for hole in holes if len(hole) >= 3]))  # fewer enclose nothing
    return result


def _positions(nodes: Iterable[Mapping[str, Any]]) -> dict[str, tuple[float, float]]:
    found: dict[str, tuple[float, float]] = {}
    for node in nodes:
        position = _position(node)
        if found.setdefault(node["token"], position) != position:
            raise ValueError(f"the node {node['token']} lies in two places")
    return found


def _position(node: Mapping[str, Any]) -> tuple[float, float]:
    x, y = float(node["x"]), float(node["y"])
    if not (abs(x) <= FARTHEST_POSE and abs(y) <= FARTHEST_POSE):
        raise ValueError(f"the node {node['token']} is not finite, or more than {FARTHEST_POSE:g} m away")
    return x, y


def _line(points: Sequence[tuple[float, float]]) -> LineString:
    """Return a line; one of a single node is empty, and stays for its index."""
    return LineString(points if len(points) > 1 else [])
