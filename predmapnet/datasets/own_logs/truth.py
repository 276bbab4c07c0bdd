"""Ground truth of a log of one's own: lines of the whole drive, in ``truth.json`` or ``truth.geojson``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import shapely

from mapfusion.arrays import Float, Integer
from mapfusion.elements import ElementKind, GlobalMap, MapElement, RegionOfInterest
from mapfusion.formats.by_suffix import read_map
from mapfusion.geometry import FARTHEST_POSE
from mapfusion.georeference import InvertibleGeoreference
from mapfusion.ground import region
from predmapnet.datasets.fields import is_given, numbers
from predmapnet.datasets.large_tables import parse_json
from predmapnet.errors import UserError, value_errors_told
from predmapnet.scenes import FrameTruth

SHORTEST = 1.0
"""Pieces of a true element in the region that are shorter are left out, metres."""

Lines = Sequence[tuple[ElementKind, Float]]
"""Kind and points ``(n, 2)``, metres, global frame, of each element."""


def read_truth(folder: Path, georeference: InvertibleGeoreference) -> Lines | None:
    """Read the true lines of a log; None where there is no file.

    Args:
        folder: of the log.
        georeference: of its global frame, for ``truth.geojson``.

    Raises:
        UserError: a file is damaged, or lies somewhere else.
    """
    path = folder / "truth.json"
    if is_given(path):
        return _read_json(path)
    path = folder / "truth.geojson"
    if is_given(path):
        with value_errors_told():
            return [(element.kind, element.points) for element in read_map(path, georeference)]
    return None


def _read_json(path: Path) -> Lines:
    """Read lines in metres of the global frame: ``{"elements": [{"kind": "divider", "points": [[x, y], ...]}]}``."""
    kinds = {kind.label: kind for kind in ElementKind}
    content = parse_json(path.read_bytes(), path, unique=True)
    elements = content.get("elements") if isinstance(content, dict) else None
    if not isinstance(elements, list):
        raise UserError(f"{path}: an object with a list 'elements' is expected.")
    found = []
    for number, element in enumerate(elements):
        kind = kinds.get(str(element.get("kind"))) if isinstance(element, dict) else None
        try:
            points = numbers(element.get("points") if kind is not None else None)
        except ValueError:
            points = np.zeros(0)
        if kind is None or points.ndim != 2 or len(points) < 2 or points.shape[1] not in (2, 3):
            raise UserError(
                f"{path}, element {number}: a 'kind' ({', '.join(kinds)}) and 'points' [x, y] are expected."
            )
        if not (np.abs(points) <= FARTHEST_POSE).all():
            raise UserError(
                f"{path}, element {number}: the points must be finite numbers, metres, at most {FARTHEST_POSE:g}."
            )
        closed = np.concatenate([points, points[:1]]) if kind.is_ring and (points[0] != points[-1]).any() else points
        found.append((kind, closed[:, :2]))
    return found


def truth_around(lines: Lines, ego_to_global: Float, roi: RegionOfInterest) -> FrameTruth:
    """Return what of the true lines lies in the region around a pose ``(4, 4)``, in its ego frame."""
    rectangle = region(roi)
    # The way back of `transform_points`, in the plane: heights of lines are not known, those of poses may be large.
    to_ego = np.linalg.inv(ego_to_global[:2, :2])
    kinds, pieces, rows = [], [], []
    for row, (kind, points) in enumerate(lines):
        here = (points - ego_to_global[:2, 3]) @ to_ego.T
        whole = shapely.Polygon(here) if kind.is_ring else shapely.LineString(here)
        for part in shapely.get_parts(shapely.intersection(shapely.make_valid(whole), rectangle)):
            if part.geom_type == ("Polygon" if kind.is_ring else "LineString") and part.length >= SHORTEST:
                kinds.append(kind)
                pieces.append(shapely.get_coordinates(part.exterior if kind.is_ring else part))
                rows.append(row)
    return FrameTruth(np.array(kinds, dtype=np.int64), tuple(pieces), np.array(rows, dtype=np.int64))


def truth_of_drive(lines: Lines, timestamps: Integer) -> GlobalMap:
    """Return the true lines as the map of a drive, whose frames are at ``timestamps``."""
    first, last = int(timestamps[0]), int(timestamps[-1])
    elements = (MapElement(kind, points, 1.0, len(timestamps), first, last) for kind, points in lines)
    return GlobalMap(tuple(elements), {"ground_truth": True})
