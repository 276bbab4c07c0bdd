"""GeoPackage and FlatGeobuf files, through pyogrio (GDAL), with the properties of GeoJSON as columns.

A GeoPackage has one layer of lines and one of crossings, because geographic information systems expect one type of
geometry in a layer; a FlatGeobuf file has a single layer of both. Lists (``track_ids``, ``deviation_m`` and the
like) and the provenance (metadata ``predmapnet``) are JSON texts. ``number`` keeps the order of the map.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import shapely
import shapely.geometry

from mapfusion.elements import GlobalMap
from mapfusion.files import write_whole
from mapfusion.formats.geojson import elements_of, feature_of, origin_of
from mapfusion.georeference import Georeference, InvertibleGeoreference

LINES, CROSSINGS = "lines", "crossings"
LISTS = ("track_ids", "deviation_m", "sources", "source_track_ids")
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

    features = [feature_of(element, georeference) for element in global_map]
    origin = origin_of({**global_map.provenance, **(provenance or {})}, georeference)
    rows = list(enumerate(features))
    with write_whole(path) as temporary:
        try:
            if path.suffix.lower() == ".fgb":
                _write_layer(temporary, "FlatGeobuf", path.stem, "Unknown", rows, origin)
                return
            crossings = [row for row in rows if row[1]["geometry"]["type"] == "Polygon"]
            lines = [row for row in rows if row[1]["geometry"]["type"] == "LineString"]
            _write_layer(temporary, "GPKG", LINES, "LineString", lines, origin)
            _write_layer(temporary, "GPKG", CROSSINGS, "Polygon", crossings, origin)
        except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError) as error:
            raise OSError(f"cannot write {path}: {error}") from error


def read_geodatabase(path: Path, georeference: InvertibleGeoreference | None = None) -> GlobalMap:
    """Read a map that :func:`write_geodatabase` wrote; see :func:`mapfusion.formats.geojson.read_geojson`.

    Raises:
        ValueError: not a file of ours; says where it breaks.
        OSError: the file cannot be read.
    """
    numbered: list[tuple[int, dict[str, Any]]] = []
    origin: dict[str, Any] = {}
    boxes = []
    for layer in _layers(path):
        rows, told, box = _read_layer(path, layer)
        numbered.extend(rows)
        origin = told or origin
        boxes.extend([box] if rows and box is not None else [])
    features = [feature for _, feature in sorted(numbered, key=lambda row: row[0])]
    table = np.array(boxes, dtype=np.float64).reshape(-1, 4)
    bounds = [*table[:, :2].min(axis=0), *table[:, 2:].max(axis=0)] if len(table) else None
    return GlobalMap(elements_of(features, georeference, bounds, path), origin)


def geodatabase_box(path: Path) -> list[float] | None:
    """Return west, south, east and north of a file, degrees, from its header or index; None if it is empty."""
    import pyogrio

    infos = [pyogrio.read_info(path, layer=layer, force_total_bounds=True) for layer in _layers(path)]
    known = [info["total_bounds"] for info in infos if info["features"] and info["total_bounds"] is not None]
    boxes = np.array(known, dtype=np.float64).reshape(-1, 4)
    if not len(boxes):
        return None
    return [*boxes[:, :2].min(axis=0).tolist(), *boxes[:, 2:].max(axis=0).tolist()]


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
    for name, kind in (
        ("kind", object),
        ("confidence", np.float64),
        ("observations", np.int64),
        ("first_seen", object),
        ("last_seen", object),
        ("length_m", np.float64),
    ):
        columns[name] = np.array([row[name] for row in properties], dtype=kind)
    for name in LISTS:
        texts = [json.dumps(row[name]) if name in row else None for row in properties]
        columns[name] = np.array(texts, dtype=object)
    shapes = np.array([shapely.geometry.shape(feature["geometry"]) for _, feature in rows], dtype=object)
    raw.write(
        path,
        shapely.to_wkb(shapes),
        list(columns.values()),
        list(columns),
        layer=layer,
        driver=driver,
        geometry_type=geometry_type,
        crs="EPSG:4326",
        layer_metadata={METADATA: json.dumps(dict(origin))},
    )


def _layers(path: Path) -> list[str]:
    import pyogrio
    import pyogrio.errors

    if not path.is_file():
        raise FileNotFoundError(2, "No such file or directory", str(path))
    try:
        return [str(name) for name in pyogrio.list_layers(path)[:, 0]]
    except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError) as error:
        raise ValueError(f"{path}: cannot be read as a map: {error}") from error


def _read_layer(path: Path, layer: str) -> tuple[list[tuple[int, dict[str, Any]]], dict[str, Any], Any]:
    """Return numbered features, the provenance and the bounds of a layer."""
    import pyogrio
    import pyogrio.errors
    from pyogrio import raw

    try:
        info = pyogrio.read_info(path, layer=layer, force_total_bounds=True)
        meta, _, geometry, values = raw.read(path, layer=layer)
    except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError) as error:
        raise ValueError(f"{path}: layer {layer} cannot be read: {error}") from error
    columns = dict(zip(meta["fields"].tolist(), values, strict=True))
    missing = sorted({"number", "kind", "confidence", "observations", "first_seen", "last_seen"} - set(columns))
    if missing:
        raise ValueError(f"{path}: layer {layer} is not a map of ours: it lacks the columns {', '.join(missing)}")
    shapes = shapely.from_wkb(geometry)
    rows = []
    for place, shape in enumerate(shapes):
        properties = {name: column[place] for name, column in columns.items()}
        for name in LISTS:
            text = properties.pop(name, None)
            if isinstance(text, str):
                properties[name] = json.loads(text)
        properties.setdefault("track_ids", [])
        number = int(properties.pop("number"))
        rows.append((number, {"geometry": shapely.geometry.mapping(shape), "properties": properties}))
    told = json.loads((info.get("layer_metadata") or {}).get(METADATA, "{}"))
    return rows, told, info["total_bounds"]
