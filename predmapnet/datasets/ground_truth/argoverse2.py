"""Ground truth from an Argoverse 2 vector map, frame by frame as the official vector-map code forms it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import LineString, Polygon, STRtree

from mapfusion.arrays import Float
from mapfusion.elements import ElementKind, RegionOfInterest
from mapfusion.geometry import FARTHEST_POSE, inverse_pose
from predmapnet.datasets.ground_truth.crossings import MINIMUM_AREA
from predmapnet.datasets.ground_truth.lane_dividers import (
    LaneSide,
    Sides,
    chain_dividers,
    connected,
    off_boundaries,
    relinked,
    twins_of,
    without_repeats,
    without_shared,
    without_twins,
)
from predmapnet.datasets.ground_truth.map_file import MALFORMED, read_map_file
from predmapnet.datasets.ground_truth.patch import (
    BORDER,
    area_rings,
    crossing_contours,
    cut_rings,
    midpoint,
    nearest_rows,
    parts_of_type,
    patch_polygon,
)
from predmapnet.datasets.ground_truth.whole_map import drop_repeated_lines, join_lines
from predmapnet.errors import UserError
from predmapnet.scenes import FrameTruth

TILT_MARGIN = 5.0
"""Crossings are moved to the ego frame with roll and pitch; those this far outside the patch cannot come in."""


class Argoverse2GroundTruth:
    """The vector map of one log: the ground truth around any pose.

    What does not depend on the frame is done once: which lanes are valid, which boundaries repeat each other, and, for
    each set of lanes in view, the chained divider lines.

    Attributes:
        fingerprint: digest of the map that this was made from.
    """

    def __init__(self, map_file: Path | Mapping[str, Any]) -> None:
        """Read ``log_map_archive_*.json``, or its content; raises UserError for anything but a vector map."""
        content, self.fingerprint = read_map_file(map_file)
        name = "the map" if isinstance(map_file, Mapping) else str(map_file)
        try:
            lanes = [lane for lane in content["lane_segments"].values() if _has_sides(lane)]
            crossings = [
                np.concatenate([_points(record["edge1"]), _points(record["edge2"])[::-1]])
                for record in content["pedestrian_crossings"].values()
            ]
            areas = [_points(record["area_boundary"]) for record in content["drivable_areas"].values()]
            areas = [points for points in areas if len(points) >= 3]  # fewer enclose nothing
            self._index_lanes(lanes)
            self._crossings = np.array([Polygon(line if len(line) >= 3 else None) for line in crossings], dtype=object)
            drivable = np.array([Polygon(points) for points in areas], dtype=object)
        except MALFORMED as error:
            raise UserError(
                f"{name} is not an Argoverse 2 vector map ({type(error).__name__}: {error}). Fetch the log again."
            ) from None
        self._crossing_tree = STRtree(self._crossings)
        self._drivable = drivable[shapely.is_valid(drivable)] if len(drivable) else drivable
        self._drivable_tree = STRtree(self._drivable)
        self._chains: dict[tuple[int, ...], list[LineString]] = {}

    def _index_lanes(self, lanes: Sequence[Mapping[str, Any]]) -> None:
        left = [_points(lane["left_lane_boundary"]) for lane in lanes]
        right = [_points(lane["right_lane_boundary"]) for lane in lanes]
        polygons = np.array(
            [Polygon(np.concatenate([r[:, :2], k[::-1, :2]])) for k, r in zip(left, right, strict=True)], dtype=object
        )
        outside = np.array([not lane["is_intersection"] for lane in lanes], dtype=bool)
        rows = np.flatnonzero(shapely.is_valid(polygons) & outside) if len(lanes) else np.zeros(0, dtype=np.int64)
        self._lane_rows = rows
        self._lane_tree = STRtree(polygons[rows])
        self._left = {row: _side(lanes[row], left[row], "left") for row in rows.tolist()}
        self._right = {row: _side(lanes[row], right[row], "right") for row in rows.tolist()}
        self._left_twins = twins_of([side for side in self._left.values() if side is not None])
        self._right_twins = twins_of([side for side in self._right.values() if side is not None])

    def frame(self, ego_to_global: Float, roi: RegionOfInterest) -> FrameTruth:
        """Return the truth of a region around one pose ``(4, 4)``, ego frame: crossings, dividers, boundaries.

        Roll, pitch and height of the pose enter as in the official code.
        """
        patch = self.region(ego_to_global, roi)
        global_to_ego = inverse_pose(ego_to_global)
        crossings, crossing_ids = self._frame_crossings(patch, global_to_ego, roi)
        boundaries = self._frame_boundaries(patch, global_to_ego, roi)
        dividers = off_boundaries(self._frame_dividers(patch, global_to_ego), boundaries)
        groups = (crossings, dividers, boundaries)
        return FrameTruth(
            kinds=np.repeat([kind.value for kind in ElementKind], [len(group) for group in groups]).astype(np.int64),
            polylines=tuple(np.ascontiguousarray(line[:, :2]) for group in groups for line in group),
            element_ids=np.array(
                [
                    *crossing_ids,
                    *nearest_rows(self._divider_tree, [_middle(line, ego_to_global) for line in dividers]),
                    *nearest_rows(self._ring_tree, [_middle(line, ego_to_global) for line in boundaries]),
                ],
                dtype=np.int64,
            ),
        )

    def region(self, ego_to_global: Float, roi: RegionOfInterest) -> Polygon:
        """Return the rectangle that a frame covers, in the city frame."""
        angle = math.atan2(ego_to_global[1, 0], ego_to_global[0, 0]) / math.pi * 180
        return patch_polygon(ego_to_global[:2, 3], roi.length, roi.width, angle)

    def _frame_crossings(
        self, patch: Polygon, global_to_ego: Float, roi: RegionOfInterest
    ) -> tuple[list[Float], list[int]]:
        near = np.sort(self._crossing_tree.query(patch, predicate="dwithin", distance=TILT_MARGIN))
        polygons = list(_moved(self._crossings[near], global_to_ego))
        contours = crossing_contours(polygons, _box(roi, 0.0))
        kept = [
            (contour, int(row))
            for contour, row in zip(contours, near, strict=True)
            if contour is not None and len(contour) >= 4 and Polygon(contour).area >= MINIMUM_AREA
        ]
        return [contour for contour, _ in kept], [row for _, row in kept]

    def _frame_boundaries(self, patch: Polygon, global_to_ego: Float, roi: RegionOfInterest) -> list[Float]:
        near = np.sort(self._drivable_tree.query(patch, predicate="intersects"))
        parts, _ = parts_of_type(shapely.intersection(self._drivable[near], patch), "Polygon")
        moved = _moved(np.array(parts, dtype=object), global_to_ego)
        rings = area_rings(shapely.union_all(moved[shapely.is_valid(moved)])) if len(moved) else []
        return cut_rings(rings, _box(roi, BORDER)) if rings else []

    def _frame_dividers(self, patch: Polygon, global_to_ego: Float) -> list[Float]:
        near = np.sort(self._lane_tree.query(patch, predicate="intersects"))
        lines, _ = parts_of_type(shapely.intersection(self._chained(near), patch), "LineString")
        if not lines:
            return []
        moved = without_repeats(list(_moved(np.array(lines, dtype=object), global_to_ego)))
        return connected([shapely.get_coordinates(line, include_z=True) for line in moved])

    def _chained(self, near: NDArray[np.int64]) -> list[LineString]:
        """Steps 2 to 6 for the lanes in view; they stay the same over many frames."""
        key = tuple(self._lane_rows[near].tolist())
        if key not in self._chains:
            left, right = self._unique_sides(key)
            self._chains[key] = chain_dividers(relinked(left)) + chain_dividers(relinked(right))
        return self._chains[key]

    def _unique_sides(self, rows: Sequence[int]) -> tuple[Sides, Sides]:
        left = {side.lane: side for row in rows if (side := self._left[row]) is not None}
        right = {side.lane: side for row in rows if (side := self._right[row]) is not None}
        left, right = (dict(sides) for sides in without_shared(left, right))
        return without_twins(left, self._left_twins), without_twins(right, self._right_twins)

    @cached_property
    def rings(self) -> list[LineString]:
        """Rings of the drivable surface of the whole map, drivable side on the right hand, city frame."""
        return area_rings(shapely.force_2d(shapely.union_all(self._drivable)))

    @cached_property
    def divider_lines(self) -> list[Float]:
        """Dividers of the whole map, joined where exactly two run on into each other, ``(n, 2)``, city frame."""
        sides = [side for group in self._unique_sides(self._lane_rows.tolist()) for side in group.values()]
        return join_lines(drop_repeated_lines([side.points[:, :2] for side in sides]))

    @cached_property
    def _ring_tree(self) -> STRtree:
        return STRtree(self.rings)

    @cached_property
    def _divider_tree(self) -> STRtree:
        return STRtree([LineString(line) for line in self.divider_lines])

    def elements_within(self, area: Any) -> list[tuple[ElementKind, Float]]:
        """Return kind and points ``(n, 2)`` of whole elements, cut by an area of the city frame.

        Dividers along a boundary are left out.
        """
        crossings, _ = parts_of_type(
            shapely.intersection(shapely.make_valid(shapely.force_2d(self._crossings)), area), "Polygon"
        )
        lines, _ = parts_of_type(
            shapely.intersection([LineString(line) for line in self.divider_lines], area), "LineString"
        )
        boundaries = cut_rings(self.rings, area) if self.rings else []
        dividers = off_boundaries([shapely.get_coordinates(line) for line in lines], boundaries)
        return [
            *(
                (ElementKind.PED_CROSSING, shapely.get_coordinates(polygon.exterior))
                for polygon in crossings
                if polygon.area >= MINIMUM_AREA
            ),
            *((ElementKind.DIVIDER, line) for line in dividers),
            *((ElementKind.BOUNDARY, line) for line in boundaries),
        ]


def united_map(files: Sequence[Path]) -> dict[str, dict[str, Any]]:
    """Unite the vector maps of several logs of one city, which hold the same record by the same id.

    Drivable areas are all kept, since logs hold what is near to them; where they overlap they are one surface anyway.
    """
    united: dict[str, dict[str, Any]] = {"lane_segments": {}, "pedestrian_crossings": {}, "drivable_areas": {}}
    for file in files:
        content, digest = read_map_file(file)
        for layer, records in united.items():
            found = content.get(layer)
            if not isinstance(found, Mapping):
                raise UserError(f"{file} is not an Argoverse 2 vector map: it lacks {layer}. Fetch the log again.")
            own = digest.hex() if layer == "drivable_areas" else ""
            records.update({f"{own}{name}": record for name, record in found.items()})
    return united


def _has_sides(lane: Mapping[str, Any]) -> bool:
    """Whether a lane has a line on either side; a single point is none."""
    return min(len(lane["left_lane_boundary"]), len(lane["right_lane_boundary"])) >= 2


def _side(lane: Mapping[str, Any], points: Float, which: str) -> LaneSide | None:
    neighbour = lane[f"{which}_neighbor_id"]
    if neighbour is None:
        return None
    linked = [lane["id"], neighbour, *lane["predecessors"], *lane["successors"]]
    if not all(isinstance(number, (int, str)) for number in linked):
        raise ValueError(f"the lane {str(lane['id'])[:40]} has ids that are none: {str(linked)[:80]}")
    return LaneSide(lane["id"], points, neighbour, tuple(lane["predecessors"]), tuple(lane["successors"]))


def _points(records: Sequence[Mapping[str, float]]) -> Float:
    """Return ``(n, 3)`` points. Heights that are NaN, as in some published maps, become the mean of the others."""
    points = np.array([(point["x"], point["y"], point["z"]) for point in records], dtype=np.float64).reshape(-1, 3)
    heights = np.isfinite(points[:, 2])
    if not heights.all():
        points[~heights, 2] = points[heights, 2].mean() if heights.any() else 0.0
    if not (np.abs(points) <= FARTHEST_POSE).all():
        raise ValueError(f"a point is not finite, or more than {FARTHEST_POSE:g} m away")
    return points


def _moved(geometries: NDArray[Any], pose: Float) -> NDArray[Any]:
    """Move geometries with z by a full pose."""

    def move(points: Float) -> Float:
        return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])

    return np.asarray(shapely.transform(geometries, move, include_z=True))


def _box(roi: RegionOfInterest, margin: float) -> Polygon:
    x, y = roi.length / 2 - margin, roi.width / 2 - margin
    return shapely.box(-x, -y, x, y)


def _middle(line: Float, ego_to_global: Float) -> Float:
    return ego_to_global[:2, :2] @ midpoint(line[:, :2]) + ego_to_global[:2, 3]
