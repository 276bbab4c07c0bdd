"""GeoPackage and FlatGeobuf files, through pyogrio (GDAL), with the properties of GeoJSON as columns.

A GeoPackage has one layer of lines and one of crossings, because geographic information systems expect one type of
geometry in a layer; a FlatGeobuf file has a single layer of both. Lists (``track_ids``, ``deviation_m`` and the
like) and the provenance (metadata ``predmapnet``) are JSON texts. ``number`` keeps the order of the map.
"""

from __future__ import annotations

import json
import re
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import shapely
import shapely.geometry

from mapfusion.elements import GlobalMap
from mapfusion.formats.features import HEIGHTS, Feature, map_of
from mapfusion.formats.foreign_values import json_of, number_of
from mapfusion.formats.geojson import feature_of, origin_of
from mapfusion.formats.identities import all_named
from mapfusion.formats.reading_notes import ReadingNotes
from mapfusion.formats.reference_systems import ToDegrees
from mapfusion.formats.seal import write_sealed
from mapfusion.georeference import Georeference, InvertibleGeoreference

LINES, CROSSINGS = "lines", "crossings"
LISTS = ("track_ids", "deviation_m", "sources", "source_track_ids")
FLAT = "FlatGeobuf"
"""Driver whose layers of lines and areas together have no heights."""
METADATA = "predmapnet"


def write_geodatabase(
    global_map: GlobalMap, path: Path, georeference: Georeference, provenance: Mapping[str, Any] | None = None
) -> None:
    """Write a map as GeoPackage (``.gpkg``) or FlatGeobuf (``.fgb``), WGS84; complete or not at all.

    Raises:
        ValueError: coordinates that are not on the globe.
        OSError: the file cannot be written.
    """
    import pyogrio.errors

    features = [feature_of(element, georeference) for element in all_named(global_map)]
    origin = origin_of({**global_map.provenance, **(provenance or {})}, georeference)
    rows = list(enumerate(features))
    with write_sealed(path) as temporary, _plain_folder(temporary) as plain:
        try:
            if path.suffix.lower() == ".fgb":
                _write_layer(plain, FLAT, path.stem, "Unknown", rows, origin)
                return
            crossings = [row for row in rows if row[1]["geometry"]["type"] == "Polygon"]
            lines = [row for row in rows if row[1]["geometry"]["type"] == "LineString"]
            _write_layer(plain, "GPKG", LINES, "LineString", lines, origin)
            _write_layer(plain, "GPKG", CROSSINGS, "Polygon", crossings, origin)
        except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError) as error:
            raise OSError(f"cannot write {path}: {error}") from error


def read_geodatabase(path: Path, georeference: InvertibleGeoreference | None = None) -> GlobalMap:
    """Read a map that :func:`write_geodatabase` wrote, also after another program or a person has edited it.

    Layers of any reference system are read; those that are no map (styles, points) are left out, ``notes`` say so.
    Arguments and result are those of :func:`mapfusion.formats.geojson.read_geojson`.

    Raises:
        ValueError: no map; says where it breaks.
        OSError: the file cannot be read.
    """
    numbered: list[tuple[float, Feature]] = []
    origin: Any = None
    notes = ReadingNotes()
    with plain_path(path) as plain, driver_errors_told(path):
        for layer in _layers(plain, path, notes):
            rows, told = _read_layer(plain, path, layer)
            numbered.extend(rows)
            origin = origin or told
    features = [feature for _, feature in sorted(numbered, key=lambda row: row[0])]
    return map_of(features, origin, path, georeference, notes)


def geodatabase_box(path: Path) -> list[float] | None:
    """Return west, south, east and north of a file, degrees, from its header or index; None if it is empty."""
    import pyogrio

    boxes = []
    with plain_path(path) as plain, driver_errors_told(path):
        for layer in _layers(plain, path, ReadingNotes()):
            info = pyogrio.read_info(plain, layer=layer, force_total_bounds=True)
            bounds = info["total_bounds"]
            if info["features"] and bounds is not None and np.isfinite(bounds).all():
                boxes.append(ToDegrees(str(info["crs"] or ""), f"{path}, layer {layer}").box(bounds))
    if not boxes:
        return None
    table = np.array(boxes, dtype=np.float64)
    return [*table[:, :2].min(axis=0).tolist(), *table[:, 2:].max(axis=0).tolist()]


def _write_layer(
    path: Path,
    driver: str,
    layer: str,
    geometry_type: str,
    rows: Sequence[tuple[int, Mapping[str, Any]]],
    origin: Mapping[str, Any],
) -> None:
    from pyogrio import raw

    properties = [feature["properties"] for _, feature in rows]
    columns: dict[str, Any] = {"number": np.array([number for number, _ in rows], dtype=np.int64)}
    columns["id"] = np.array([feature["id"] for _, feature in rows], dtype=object)
    for name, kind in (
        ("kind", object),
        ("confidence", np.float64),
        ("observations", np.int64),
        ("first_seen", object),
        ("last_seen", object),
        ("length_m", np.float64),
    ):
        columns[name] = np.array([row[name] for row in properties], dtype=kind)
    columns["paint"] = np.array([row.get("paint") for row in properties], dtype=object)
    for name in LISTS:
        texts = [json.dumps(row[name]) if name in row else None for row in properties]
        columns[name] = np.array(texts, dtype=object)
    if driver == FLAT:
        columns[HEIGHTS] = np.array([_heights_text(feature["geometry"]) for _, feature in rows], dtype=object)
    shapes = np.array([shapely.geometry.shape(feature["geometry"]) for _, feature in rows], dtype=object)
    raw.write(
        path,
        shapely.to_wkb(shapes),
        list(columns.values()),
        list(columns),
        layer=layer,
        driver=driver,
        geometry_type=geometry_type + (" Z" if driver != FLAT and shapely.has_z(shapes).any() else ""),
        crs="EPSG:4326",
        layer_metadata={METADATA: json.dumps(dict(origin))},
    )


def _heights_text(geometry: Mapping[str, Any]) -> str | None:
    positions = geometry["coordinates"][0] if geometry["type"] == "Polygon" else geometry["coordinates"]
    return json.dumps([height for _, _, height in positions]) if len(positions[0]) == 3 else None


def _layers(plain: Path, path: Path, notes: ReadingNotes) -> list[str]:
    """Return the layers that hold a map; raises ValueError if there is none."""
    import pyogrio

    found: list[str] = []
    others: list[str] = []
    for name, geometry in pyogrio.list_layers(plain):
        if geometry is None:  # a table without geometries: styles of QGIS and the like
            continue
        fields = set(pyogrio.read_info(plain, layer=name)["fields"])
        (found if "kind" in fields else others).append(str(name))
    if not found:
        raise ValueError(f"{path}: not a map of ours: no layer has the column 'kind' (layers: {', '.join(others)})")
    for name in others:
        notes.add(f"the layer {name} has no column 'kind': left out")
    return found


def _read_layer(plain: Path, path: Path, layer: str) -> tuple[list[tuple[float, Feature]], Any]:
    """Return the numbered features of a layer, and the provenance."""
    import pyogrio
    from pyogrio import raw

    info = pyogrio.read_info(plain, layer=layer)
    meta, _, geometry, values = raw.read(plain, layer=layer)
    to_degrees = ToDegrees(str(info["crs"] or ""), f"{path}, layer {layer}") if len(geometry) else _WGS84
    columns = dict(zip(meta["fields"].tolist(), values, strict=True))
    numbers = columns.pop("number", np.full(len(geometry), np.nan))
    rows = []
    for place, shape in enumerate(shapely.from_wkb(geometry)):
        content = {
            "geometry": None if shape is None else shapely.geometry.mapping(shape),
            "properties": {name: column[place] for name, column in columns.items()},
        }
        number = number_of(numbers[place])
        rows.append((np.inf if number is None else number, Feature(content, to_degrees)))
    return rows, json_of((info.get("layer_metadata") or {}).get(METADATA))


_WGS84 = ToDegrees("EPSG:4326", "")


@contextmanager
def driver_errors_told(path: Path) -> Iterator[None]:
    """Raise what GDAL and GEOS cannot read as ValueErrors that name the file."""
    import pyogrio.errors

    if not path.is_file():
        raise FileNotFoundError(2, "No such file or directory", str(path))
    try:
        yield
    except (
        pyogrio.errors.DataSourceError,
        pyogrio.errors.DataLayerError,
        pyogrio.errors.FeatureError,
        pyogrio.errors.FieldError,
        shapely.GEOSException,
        UnicodeDecodeError,
    ) as error:
        raise ValueError(f"{path}: cannot be read as a map: {error}") from error


@contextmanager
def plain_path(path: Path) -> Iterator[Path]:
    """Yield a path to the same file that pyogrio takes as it is: it cuts names at ``!``, ``;`` and ``?``."""
    if not re.search(r"[!;?]|\.zip$", str(path)):
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        link = Path(folder) / f"map{path.suffix}"
        link.symlink_to(path.resolve())
        yield link


@contextmanager
def _plain_folder(path: Path) -> Iterator[Path]:
    """Yield a path to a file that is yet to be written, as :func:`plain_path` does for one that is there."""
    if not re.search(r"[!;?]", str(path)):
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        link = Path(folder) / "folder"
        link.symlink_to(path.parent.resolve(), target_is_directory=True)
        yield link / path.name
