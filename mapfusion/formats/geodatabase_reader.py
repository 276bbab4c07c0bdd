"""Reading of GeoPackage and FlatGeobuf files, through pyogrio (GDAL), also after other programs have edited them."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import shapely
import shapely.geometry

from mapfusion.elements import GlobalMap
from mapfusion.formats.features import Feature, map_of
from mapfusion.formats.foreign_values import json_of, number_of
from mapfusion.formats.geodatabase import METADATA, OBSERVED, REST, SPECIAL, TIMES
from mapfusion.formats.reading_notes import ReadingNotes
from mapfusion.formats.reference_systems import ToDegrees
from mapfusion.georeference import InvertibleGeoreference
from mapfusion.ground import ground_within, rings_around

BEGINNINGS = (b"SQLite format 3\0", b"fgb", b"{")
"""Of what is read; GDAL knows many more, some of which send it to other files, or to the network."""

CHANGED_GROUND = 1e-11
"""Difference from which on the layer of observed ground counts as changed, square degrees (0.1 square metres)."""


def read_geodatabase(path: Path, georeference: InvertibleGeoreference | None = None) -> GlobalMap:
    """Read a map that :func:`mapfusion.formats.geodatabase.write_geodatabase` wrote, also after it was edited.

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
        origin = _with_drawn_ground(plain, path, origin, notes)
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


def _layers(plain: Path, path: Path, notes: ReadingNotes) -> list[str]:
    """Return the layers that hold a map; raises ValueError if there is none."""
    import pyogrio

    found: list[str] = []
    others: list[str] = []
    for name, geometry in pyogrio.list_layers(plain):
        if geometry is None or name == OBSERVED:  # a table without geometries: styles of QGIS and the like
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
    for name in TIMES:
        rest = columns.pop(f"{name}{REST}", None)
        if rest is not None and name in columns and columns[name].dtype.kind == "M":
            columns[name] = columns[name].astype("datetime64[ns]") + np.nan_to_num(rest).astype("timedelta64[ns]")
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


def _with_drawn_ground(plain: Path, path: Path, origin: Any, notes: ReadingNotes) -> Any:
    """Return the provenance with the observed ground of its layer, if a person changed that or the rest was lost."""
    import pyogrio
    from pyogrio import raw

    if OBSERVED not in pyogrio.list_layers(plain)[:, 0]:
        return origin
    system = str(pyogrio.read_info(plain, layer=OBSERVED)["crs"] or "")
    shapes = [shape for shape in shapely.from_wkb(raw.read(plain, layer=OBSERVED)[2]) if shape is not None]
    to_degrees = ToDegrees(system, f"{path}, layer {OBSERVED}") if shapes else _WGS84
    drawn = shapely.union_all([shapely.make_valid(shapely.transform(s, to_degrees.positions)) for s in shapes])
    if not isinstance(origin, dict):
        notes.add("its provenance is lost; the observed ground is that of its layer")
        return {"observed": [ring.tolist() for ring in rings_around(drawn)]}
    try:
        stored = ground_within([np.array(ring, dtype=np.float64) for ring in origin.get("observed") or ()])
    except (TypeError, ValueError):
        return origin
    if shapely.symmetric_difference(stored, drawn).area <= CHANGED_GROUND:
        return origin
    notes.add("the observed ground is that of its layer, which was changed by hand")
    return {**origin, "observed": [ring.tolist() for ring in rings_around(drawn)]}


@contextmanager
def driver_errors_told(path: Path) -> Iterator[None]:
    """Raise what GDAL and GEOS cannot read as ValueErrors that name the file."""
    import pyogrio.errors

    if not path.is_file():
        raise FileNotFoundError(2, "No such file or directory", str(path))
    with path.open("rb") as file:
        if not file.read(16).startswith(BEGINNINGS):
            raise ValueError(f"{path}: not a map: its content is neither a GeoPackage nor a FlatGeobuf")
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
    """Yield a path to the same file that GDAL takes as it is; see :data:`SPECIAL`."""
    if not SPECIAL.search(str(path)) and path.suffix != ".zip":
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        link = Path(folder) / f"map{path.suffix}"
        link.symlink_to(path.resolve())
        yield link
