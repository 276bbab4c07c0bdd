"""Maps as py123d has them (Arrow IPC), which its ``ArrowMapAPI`` opens.

py123d looks for ``maps/<dataset>/<dataset>_<location>.arrow`` and ``logs/<split>/<log>/map.arrow``. Metres are those of
the map's own frame, so that they fit the poses of the log. Dividers are road lines, boundaries road edges, crossings
crosswalks. The types are ``UNKNOWN``: there is no road line without a colour, and an edge may be a median. A height
that is not known is 0. The schema and the features of each row have a member ``predmapnet`` with what is known.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pyarrow as pa
import shapely

from mapfusion import json_text
from mapfusion.elements import ElementKind, GlobalMap, MapElement
from mapfusion.formats.features import Feature, map_of
from mapfusion.formats.frame_ties import MEMBER, TiedFrame, ties_of
from mapfusion.formats.geojson import feature_of, origin_of
from mapfusion.formats.identities import StableNumbers, all_named
from mapfusion.formats.json_documents import tied_feature
from mapfusion.formats.reading_notes import ReadingNotes
from mapfusion.formats.reference_systems import ToDegrees
from mapfusion.formats.seal import write_sealed
from mapfusion.georeference import Georeference, InvertibleGeoreference

LAYERS = {ElementKind.PED_CROSSING: 3, ElementKind.BOUNDARY: 8, ElementKind.DIVIDER: 9}
"""Numbers of the layers ``CROSSWALK``, ``ROAD_EDGE`` and ``ROAD_LINE``."""
TYPES = {ElementKind.BOUNDARY: {"road_edge_type": 0}, ElementKind.DIVIDER: {"road_line_type": 1}}
"""Numbers of the type ``UNKNOWN``."""
VERSION = "0.7.0"
"""Version of py123d whose format this is."""
SCHEMA = pa.schema(
    {"object_id": pa.int64(), "map_layer": pa.int8(), "features": pa.binary(), "wkb": pa.binary()}.items()
)

MALFORMED = (pa.ArrowException, OSError, KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError,
             shapely.errors.ShapelyError)  # fmt: skip
"""Errors of a reader on a file that is damaged or another's; Arrow calls damage an OSError."""


def write_py123d(
    global_map: GlobalMap, path: Path, georeference: Georeference, provenance: Mapping[str, Any] | None = None
) -> None:
    """Write a map of py123d (``.arrow``); complete or not at all.

    Raises:
        ValueError: coordinates that are not on the globe.
        OSError: the file cannot be written.
    """
    origin = origin_of({**global_map.provenance, **(provenance or {})}, georeference)
    origin["ties"] = ties_of(global_map, georeference)
    numbers = StableNumbers()
    rows = [{"object_id": numbers.of(e.name), **_row(e, georeference)} for e in all_named(global_map)]
    metadata = {
        "dataset": "predmapnet",
        "split": None,
        "log_name": None,
        "location": str(origin.get("scene") or "map"),
        "map_has_z": all(element.heights is not None for element in global_map),
        "map_is_per_log": False,
        "version": VERSION,
    }
    told = {b"metadata": msgpack.packb(metadata), MEMBER.encode(): json.dumps(origin, allow_nan=False).encode()}
    table = pa.Table.from_pylist(rows, schema=SCHEMA.with_metadata(told))
    with write_sealed(path) as temporary, pa.ipc.new_file(str(temporary), table.schema) as file:
        file.write_table(table)


def _row(element: MapElement, georeference: Georeference) -> dict[str, Any]:
    element = element.counter_clockwise() if element.kind.is_ring else element
    feature = feature_of(element, georeference)
    heights = np.zeros(len(element.points)) if element.heights is None else element.heights
    points = np.column_stack([element.points, heights])
    told: dict[str, Any] = {MEMBER: json.dumps({"id": feature["id"], **feature["properties"]}, allow_nan=False)}
    if element.kind.is_ring:
        shape = shapely.Polygon(element.points)
        # As py123d packs arrays.
        array = {b"__ndarray__": True, b"dtype": "<f8", b"shape": points.shape, b"data": points.astype("<f8").tobytes()}
        told["outline"] = array
    else:
        shape = shapely.LineString(points)
        told |= TYPES[element.kind]
    return {"map_layer": LAYERS[element.kind], "features": msgpack.packb(told), "wkb": shapely.to_wkb(shape)}


def read_py123d(path: Path, georeference: InvertibleGeoreference | None = None) -> GlobalMap:
    """Read a map that :func:`write_py123d` wrote, also after it was edited; of other layers there is a note.

    Arguments and result are those of :func:`mapfusion.formats.geojson.read_geojson`.

    Raises:
        ValueError: another file; says where it breaks.
        OSError: the file cannot be read.
    """
    content, notes = path.read_bytes(), ReadingNotes()
    try:
        table = pa.ipc.open_file(pa.py_buffer(content)).read_all()
        table.validate(full=True)
        origin = json_text.parse((table.schema.metadata or {}).get(MEMBER.encode(), b"null"))
        if not isinstance(origin, dict):
            raise ValueError(f"its schema has no member '{MEMBER}' that says where the map lies")
        features = list(_features(table, TiedFrame(origin.pop("ties", None)), notes))
    except MALFORMED as error:
        told = f"{error} is missing" if isinstance(error, KeyError) else error
        raise ValueError(f"{path}: no py123d map of ours as it should be: {told}") from error
    to_degrees = ToDegrees("EPSG:4326", str(path))
    return map_of((Feature(feature, to_degrees) for feature in features), origin, path, georeference, notes)


def _features(table: pa.Table, frame: TiedFrame, notes: ReadingNotes) -> Iterator[dict[str, Any]]:
    kinds = {layer: kind for kind, layer in LAYERS.items()}
    for row in table.to_pylist():
        kind = kinds.get(row["map_layer"])
        if kind is None:
            notes.add("objects of layers that are no road line, road edge or crosswalk are left out")
            continue
        told = msgpack.unpackb(row["features"])
        properties = json.loads(told[MEMBER]) if MEMBER in told else None
        shape = shapely.from_wkb(row["wkb"])
        points = shapely.get_coordinates(shape.exterior if kind.is_ring else shape, include_z=True)
        if kind.is_ring:
            points[:, 2] = _heights(told.get("outline"), points[:, :2])
        yield tied_feature(kind, np.nan_to_num(points).tolist(), properties, frame)


def _heights(outline: Any, points: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Return the heights of a crosswalk's outline; zeros if its polygon has been changed since."""
    if isinstance(outline, dict) and b"data" in outline and len(outline[b"data"]) == 24 * len(points):
        known = np.frombuffer(outline[b"data"], dtype="<f8").reshape(-1, 3)
        if np.array_equal(known[:, :2], points):
            return known[:, 2]
    return np.zeros(len(points))
