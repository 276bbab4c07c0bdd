"""Reading and writing of map files; the ending of the name chooses the format."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from mapfusion.arrays import Float
from mapfusion.elements import GlobalMap, MapElement
from mapfusion.formats.argoverse2_archive import read_argoverse2, write_argoverse2
from mapfusion.formats.foreign_values import json_of
from mapfusion.formats.geodatabase import write_geodatabase
from mapfusion.formats.geodatabase_reader import geodatabase_box, read_geodatabase
from mapfusion.formats.geojson import GeoJsonWriter, read_geojson, write_geojson
from mapfusion.formats.lanelet2 import write_lanelet
from mapfusion.formats.lanelet2_reader import read_lanelet
from mapfusion.formats.local_plane import LocalPlane, common_plane
from mapfusion.formats.nuscenes_expansion import read_nuscenes, write_nuscenes
from mapfusion.formats.opendrive import write_opendrive
from mapfusion.formats.opendrive_reader import read_opendrive
from mapfusion.formats.py123d_map import read_py123d, write_py123d
from mapfusion.formats.reference_systems import FromDegrees
from mapfusion.georeference import LOCAL_FRAME, Georeference, InvertibleGeoreference

SUFFIXES = {
    ".geojson": "GeoJSON",
    ".json": "GeoJSON",
    ".gpkg": "GeoPackage",
    ".fgb": "FlatGeobuf",
    ".osm": "Lanelet2",
    ".xodr": "OpenDRIVE",
    ".nuscenes.json": "nuScenes",
    ".argoverse2.json": "Argoverse 2",
    ".arrow": "py123d",
}
"""Endings of the files that hold maps, and the format of each; where several fit, the longest counts."""

_WRITERS = {
    "GeoJSON": write_geojson,
    "GeoPackage": write_geodatabase,
    "FlatGeobuf": write_geodatabase,
    "Lanelet2": write_lanelet,
    "OpenDRIVE": write_opendrive,
    "nuScenes": write_nuscenes,
    "Argoverse 2": write_argoverse2,
    "py123d": write_py123d,
}
_READERS = {
    "GeoJSON": read_geojson,
    "GeoPackage": read_geodatabase,
    "FlatGeobuf": read_geodatabase,
    "Lanelet2": read_lanelet,
    "OpenDRIVE": read_opendrive,
    "nuScenes": read_nuscenes,
    "Argoverse 2": read_argoverse2,
    "py123d": read_py123d,
}


_ONE_SYSTEM = {
    "GeoJSON": "RFC 7946 allows longitude and latitude (WGS84) alone",
    "Lanelet2": "its nodes have latitude and longitude",
    "OpenDRIVE": "it is projected about the origin of the map's frame",
}
"""Reason why a format has one reference system."""


def map_suffix(path: Path) -> str | None:
    """Return the ending of a name that stands for a map format, in lower case; None if it has none."""
    return max((suffix for suffix in SUFFIXES if path.name.lower().endswith(suffix)), key=len, default=None)


def check_suffix(path: Path) -> str:
    """Return the format that the ending of a name stands for; raises ValueError for other endings."""
    suffix = map_suffix(path)
    if suffix is None:
        endings = ", ".join(f"{suffix} ({name})" for suffix, name in SUFFIXES.items())
        raise ValueError(f"{path}: the ending '{path.suffix}' stands for no map format; use one of {endings}")
    return SUFFIXES[suffix]


def check_crs(path: Path, crs: str | None) -> None:
    """Check that a map can be written in a reference system, an EPSG code; None is the one of the format.

    Raises:
        ValueError: the format has only one, or PROJ does not know it.
    """
    if crs is None:
        return
    name = check_suffix(path)
    if name not in ("GeoPackage", "FlatGeobuf"):
        reason = _ONE_SYSTEM.get(name, "its metres are those of the map's own frame")
        raise ValueError(f"{path}: {name} cannot be written in {crs}: {reason}. Write .gpkg or .fgb for {crs}")
    FromDegrees(crs)


def maps_in(folder: Path) -> list[Path]:
    """Return the maps in a folder and below it, in the order of their names; raises ValueError if there is none."""
    # Summaries and other things are JSON, too.
    files = (file for file in sorted(folder.rglob("*")) if map_suffix(file) not in (None, ".json"))
    found = [file for file in files if not file.name.startswith(".")]
    if not found:
        raise ValueError(f"there is no map in the folder {folder}; maps end in {', '.join(SUFFIXES)}")
    return found


def write_map(
    global_map: GlobalMap,
    path: Path,
    georeference: Georeference,
    provenance: Mapping[str, Any] | None = None,
    crs: str | None = None,
) -> None:
    """Write a map in the format that the ending of the name asks for; the file appears complete or not at all.

    Every format keeps all that a :class:`~mapfusion.elements.MapElement` holds: positions to 0.1 mm, deviations to
    1 mm and confidences to 0.0001. Rings turn counter-clockwise. :func:`read_map` gives it back.

    Args:
        global_map: elements in the metric global frame.
        path: file to write; an existing one is replaced.
        georeference: of that frame.
        provenance: what else the file should tell of its origin.
        crs: reference system of a GeoPackage or FlatGeobuf (``EPSG:32632``); WGS84 without.

    Raises:
        ValueError: an ending that stands for no format, coordinates not on the globe, or a system that does not fit.
        OSError: the file cannot be written.
    """
    check_crs(path, crs)
    if crs is not None:
        write_geodatabase(global_map, path, georeference, provenance, crs)
        return
    _WRITERS[check_suffix(path)](global_map, path, georeference, provenance)


class MapWriter:
    """Writes a map element by element; GeoJSON as they come, other formats at the end.

    Use it as a context manager. An exception inside leaves no file.

    Args:
        path: file to write; its ending says the format.
        georeference: of the metric frame.
        provenance: what the file should tell of its origin.
        crs: as for :func:`write_map`.

    Raises:
        ValueError: an ending that stands for no format.
    """

    def __init__(
        self, path: Path, georeference: Georeference, provenance: Mapping[str, Any], crs: str | None = None
    ) -> None:
        check_crs(path, crs)
        self._path, self._georeference, self._provenance, self._crs = path, georeference, provenance, crs
        streams = check_suffix(path) == "GeoJSON"
        self._stream = GeoJsonWriter(path, georeference, provenance) if streams else None
        self._elements: list[MapElement] = []

    def __enter__(self) -> Self:
        if self._stream is not None:
            self._stream.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._stream is not None:
            self._stream.__exit__(kind, error, trace)
        elif kind is None:
            found = GlobalMap(tuple(self._elements), self._provenance)
            write_map(found, self._path, self._georeference, crs=self._crs)

    def write(self, element: MapElement) -> None:
        """Append one element."""
        if self._stream is not None:
            self._stream.write(element)
        else:
            self._elements.append(element)


def read_map(path: Path, georeference: InvertibleGeoreference | None = None) -> GlobalMap:
    """Read a map that :func:`write_map` wrote, also after another program or a person has edited it.

    ``notes`` of the map tell what was repaired, supplied or left out.

    Args:
        path: the file.
        georeference: leads to the metric frame; without one the map is in metres about the middle of its bounds.

    Raises:
        ValueError: an ending that stands for no format, or a file that is not as it should be.
        OSError: the file cannot be read.
    """
    return _READERS[check_suffix(path)](path, georeference)


def read_maps(paths: Sequence[Path]) -> tuple[list[GlobalMap], LocalPlane]:
    """Read maps of one place into one metric plane.

    Returns:
        The maps, in the order of the paths, and the plane.

    Raises:
        ValueError, OSError: as :func:`read_map`, or the maps lie too far apart.
    """
    boxes = [box for box in (read_box(path) for path in paths) if box is not None]
    plane = common_plane(np.array(boxes)) if boxes else LocalPlane(0.0, 0.0)
    maps = [read_map(path, plane) for path in paths]
    check_frames((path.name, frame_of(read)) for path, read in zip(paths, maps, strict=True))
    return maps, plane


def frame_of(global_map: GlobalMap) -> str:
    """Return the name of a map's local frame, whose place on Earth is not known; empty for a map that lies on Earth."""
    return str(global_map.provenance.get(LOCAL_FRAME) or "")


def check_frames(maps: Iterable[tuple[str, str]]) -> None:
    """Refuse maps of different local frames, which only seem to lie at one place.

    Args:
        maps: names of the maps, and of their frames (:func:`frame_of`).

    Raises:
        ValueError: their places on Earth are not known, and their frames are not the same.
    """
    frames = {frame: name for name, frame in maps}
    if len(frames) > 1:
        (first, one), (second, other) = list(frames.items())[:2]
        raise ValueError(
            f"{one} and {other} do not lie in one frame ({first or 'on Earth'}; {second or 'on Earth'}): map the logs "
            "again and say with --origin where their frames lie"
        )


def read_box(path: Path) -> Float | None:
    """Return west, south, east and north of a map, degrees, without reading all of it; None if it is empty.

    Raises:
        ValueError, OSError: as :func:`read_map`.
    """
    match check_suffix(path):
        case "GeoPackage" | "FlatGeobuf":
            box = geodatabase_box(path)
        case "GeoJSON":
            with path.open(encoding="utf-8-sig", errors="replace") as file:
                head = file.read(512)
            found = re.match(r'\s*\{"type":"FeatureCollection","bbox":(\[[^]]*\])', head)
            box = (json_of(found[1]) if found else None) or _box_of_points(path)
        case _:
            box = _box_of_points(path)
    if box is None:
        return None
    if len(box) == 6:  # with heights
        box = [*box[:2], *box[3:5]]
    try:
        numbers = np.array(box, dtype=np.float64)
    except (TypeError, ValueError):
        numbers = np.zeros(0)
    if numbers.shape != (4,) or not np.isfinite(numbers).all():
        raise ValueError(f"{path}: the bounding box is not four numbers: {box}")
    if not (np.abs(numbers) <= [180.0, 90.0, 180.0, 90.0]).all():
        raise ValueError(f"{path}: the positions are not longitude and latitude in degrees (WGS84): {box}")
    return numbers


def _box_of_points(path: Path) -> list[float] | None:
    """Return the bounds of a file that does not begin with them."""
    elements = read_map(path, _Degrees()).elements
    if not elements:
        return None
    points = np.concatenate([element.points for element in elements])
    return [*points.min(axis=0).tolist(), *points.max(axis=0).tolist()]


class _Degrees:
    """Georeference that leaves longitude and latitude as they are."""

    name = "degrees"

    def to_wgs84(self, points: Float) -> Float:
        return points

    def from_wgs84(self, points: Float) -> Float:
        return points
