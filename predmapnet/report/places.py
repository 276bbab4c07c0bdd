"""Places of maps: maps that lie near each other are of one place, and places are laid out side by side on one sheet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import shapely

from mapfusion.arrays import Float
from mapfusion.elements import GlobalMap
from mapfusion.formats.by_suffix import frame_of, read_box, read_map
from mapfusion.formats.local_plane import LocalPlane

NEAR = 0.02
"""Maps whose bounds come this close are of one place, degrees."""

GAP = 60.0
"""Between two places on the sheet, metres, and a tenth of the larger one."""


@dataclass(frozen=True)
class PlacedMap:
    """Map of a file on the sheet.

    Attributes:
        name: of the drive or the file.
        global_map: in metres of its place.
        place: number of the place.
    """

    name: str
    global_map: GlobalMap
    place: int


@dataclass(frozen=True)
class Place:
    """Place on Earth, or a frame whose place is not known.

    Attributes:
        name: for people.
        plane: metres about its middle; None if it does not matter where it is.
        low, high: bounds of its maps ``(2,)``, metres of the plane.
        shift: ``(2,)``, from the plane to the sheet, metres.
    """

    name: str
    plane: LocalPlane | None
    low: Float
    high: Float
    shift: Float


@dataclass(frozen=True)
class _Loaded:
    name: str
    global_map: GlobalMap
    box: Float


def lay_out(files: Sequence[tuple[str, Path]]) -> tuple[list[Place], list[PlacedMap], list[tuple[str, str]]]:
    """Read maps and lay them out.

    Args:
        files: names and paths.

    Returns:
        The places on the sheet, the maps that have elements, and names of files that cannot be read with the reason.
    """
    loaded, unread = [], []
    for name, path in files:
        try:
            box = read_box(path)
            if box is not None:
                plane = LocalPlane(*((box[:2] + box[2:]) / 2).tolist())
                in_degrees = read_map(path, plane).moved(plane.to_wgs84)
                loaded.append(_Loaded(name, in_degrees, box))
        except (ValueError, OSError) as error:
            unread.append((name, str(error)))
    places: list[Place] = []
    placed: list[PlacedMap] = []
    for members in _clusters(loaded):
        low = np.min([member.box[:2] for member in members], axis=0)
        high = np.max([member.box[2:] for member in members], axis=0)
        plane = LocalPlane(*((low + high) / 2).tolist())
        number = len(places)
        placed.extend(PlacedMap(item.name, item.global_map.moved(plane.from_wgs84), number) for item in members)
        bounds = plane.from_wgs84(np.stack([low, high]))
        places.append(Place(_name_of(members), plane, bounds[0], bounds[1], np.zeros(2)))
    return side_by_side(places), placed, unread


def _clusters(loaded: Sequence[_Loaded]) -> list[list[_Loaded]]:
    """Return maps that are near each other and of one frame, largest places first."""
    groups: dict[tuple[str, int], list[_Loaded]] = {}
    if not loaded:
        return []
    boxes = np.array([member.box for member in loaded]) + NEAR / 2 * np.array([-1.0, -1.0, 1.0, 1.0])
    tree = shapely.STRtree(shapely.get_parts(shapely.union_all(shapely.box(*boxes.T))))
    rows, found = tree.query(shapely.points([member.box[:2] for member in loaded]), predicate="intersects")
    for row, area in zip(rows.tolist(), found.tolist(), strict=True):
        groups.setdefault((frame_of(loaded[row].global_map), area), []).append(loaded[row])
    return sorted(groups.values(), key=len, reverse=True)


def _name_of(members: Sequence[_Loaded]) -> str:
    locations = sorted({str(member.global_map.provenance.get("location") or "") for member in members} - {""})
    if locations:
        return ", ".join(locations[:3]) + (" ..." if len(locations) > 3 else "")
    longitude, latitude = (members[0].box[:2] + members[0].box[2:]) / 2
    return f"{latitude:.3f}, {longitude:.3f}"


def side_by_side(places: Sequence[Place]) -> list[Place]:
    """Return the places in rows, the tallest first, so that the sheet is about as wide as a screen."""
    if not places:
        return []
    sizes = np.array([place.high - place.low for place in places])
    gap = GAP + 0.1 * float(sizes.max())
    widest = max(float(np.sqrt(2.2 * (sizes + gap).prod(axis=1).sum())), float(sizes[:, 0].max()))
    corner, row_height = np.zeros(2), 0.0
    laid = list(places)
    for number in np.argsort(-sizes[:, 1], kind="stable"):
        if corner[0] > 0.0 and corner[0] + sizes[number, 0] > widest:
            corner, row_height = np.array([0.0, corner[1] - row_height - gap]), 0.0
        top_left = np.array([places[number].low[0], places[number].high[1]])
        laid[number] = replace(places[number], shift=corner - top_left)
        corner = corner + np.array([sizes[number, 0] + gap, 0.0])
        row_height = max(row_height, float(sizes[number, 1]))
    return laid
