"""GeoPackage and FlatGeobuf files, through pyogrio (GDAL), with the properties of GeoJSON as columns.

A GeoPackage has one layer of lines and one of crossings, because geographic information systems expect one type of
geometry in a layer, and one of the observed ground; QGIS finds their styles in it. A FlatGeobuf file has a single layer
of lines and crossings. Times are dates of the format, to the millisecond; columns with ``_rest_ns`` have the
nanoseconds after it. Lists (``track_ids``, ``deviation_m`` and the like) and the provenance (metadata ``predmapnet``)
are JSON texts. ``number`` keeps the order of the map.
"""

from __future__ import annotations

import json
import re
import sqlite3
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import shapely
import shapely.geometry

from mapfusion.elements import GlobalMap
from mapfusion.formats.features import HEIGHTS
from mapfusion.formats.foreign_values import parse_timestamp
from mapfusion.formats.geojson import feature_of, origin_of
from mapfusion.formats.identities import all_named
from mapfusion.formats.qgis_style import layer_styles
from mapfusion.formats.reference_systems import FromDegrees
from mapfusion.formats.seal import write_sealed
from mapfusion.georeference import Georeference
from mapfusion.ground import ground_within

LINES, CROSSINGS, OBSERVED = "lines", "crossings", "observed"
LISTS = ("track_ids", "deviation_m", "sources", "source_track_ids")
TIMES, REST = ("first_seen", "last_seen"), "_rest_ns"
SPECIAL = re.compile(r"[!;?\x00-\x1f\ud800-\udfff]|^\w\w+:")
"""Parts of names that pyogrio cuts at, GDAL drops, UTF-8 lacks, or that name a driver in place of a file."""
FLAT = "FlatGeobuf"
"""Driver whose layers of lines and areas together have no heights."""
METADATA = "predmapnet"
WGS84 = "EPSG:4326"
UTC_OFFSET = 100
"""GDAL's code of times that are UTC."""


def write_geodatabase(
    global_map: GlobalMap,
    path: Path,
    georeference: Georeference,
    provenance: Mapping[str, Any] | None = None,
    crs: str = WGS84,
) -> None:
    """Write a map as GeoPackage (``.gpkg``) or FlatGeobuf (``.fgb``); complete or not at all.

    Raises:
        ValueError: coordinates that are not on the globe, or lie where the reference system ``crs`` does not hold.
        OSError: the file cannot be written.
    """
    import pyogrio.errors

    system = FromDegrees(crs)
    features = [feature_of(element, georeference) for element in all_named(global_map)]
    origin = origin_of({**global_map.provenance, **(provenance or {})}, georeference)
    rows = list(enumerate(features))
    with write_sealed(path) as temporary, _plain_folder(temporary) as plain:
        try:
            if path.suffix.lower() == ".fgb":
                _write_layer(plain, FLAT, path.stem.encode(errors="replace").decode(), "Unknown", rows, origin, system)
                return
            crossings = [row for row in rows if row[1]["geometry"]["type"] == "Polygon"]
            lines = [row for row in rows if row[1]["geometry"]["type"] == "LineString"]
            _write_layer(plain, "GPKG", LINES, "LineString", lines, origin, system)
            _write_layer(plain, "GPKG", CROSSINGS, "Polygon", crossings, origin, system)
            if origin.get("observed"):
                _write_observed(plain, origin["observed"], system)
        except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError) as error:
            raise OSError(f"cannot write {path}: {error}") from error
        _write_styles(plain, origin["created"].replace("Z", ".000Z"))


def _write_layer(
    path: Path,
    driver: str,
    layer: str,
    geometry_type: str,
    rows: Sequence[tuple[int, Mapping[str, Any]]],
    origin: Mapping[str, Any],
    system: FromDegrees,
) -> None:
    from pyogrio import raw

    columns = _columns([feature for _, feature in rows])
    columns["number"] = np.array([number for number, _ in rows], dtype=np.int64)
    if driver == FLAT:
        columns[HEIGHTS] = np.array([_heights_text(feature["geometry"]) for _, feature in rows], dtype=object)
    shapes = np.array([shapely.geometry.shape(feature["geometry"]) for _, feature in rows], dtype=object)
    raw.write(
        path,
        shapely.to_wkb(_projected(shapes, system)),
        list(columns.values()),
        list(columns),
        layer=layer,
        driver=driver,
        geometry_type=geometry_type + (" Z" if driver != FLAT and shapely.has_z(shapes).any() else ""),
        crs=system.name,
        gdal_tz_offsets={name: np.full(len(rows), UTC_OFFSET, dtype=np.int32) for name in TIMES},
        layer_metadata={METADATA: json.dumps(dict(origin))},
        **({} if driver == FLAT else {"DATETIME_PRECISION": "MILLISECOND"}),
    )


def _columns(features: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the columns of a layer, each of its own type."""
    properties = [feature["properties"] for feature in features]
    columns: dict[str, Any] = {"id": np.array([feature["id"] for feature in features], dtype=object)}
    for name, kind in (("kind", object), ("paint", object), ("confidence", np.float64), ("observations", np.int64)):
        columns[name] = np.array([row.get(name) for row in properties], dtype=kind)
    for name in TIMES:
        moments = np.array([parse_timestamp(row[name]) for row in properties], dtype=np.int64)
        columns[name] = (moments // 1_000_000).astype("datetime64[ms]")
        columns[f"{name}{REST}"] = moments % 1_000_000
    for name in ("length_m", "width_m"):
        columns[name] = np.array([row.get(name, np.nan) for row in properties], dtype=np.float64)
    means = [np.mean(row["deviation_m"]) if "deviation_m" in row else np.nan for row in properties]
    columns["mean_deviation_m"] = np.array(means, dtype=np.float64).round(3)
    for name in LISTS:
        texts = [json.dumps(row[name]) if name in row else None for row in properties]
        columns[name] = np.array(texts, dtype=object)
    return columns


def _write_observed(path: Path, rings: Sequence[Any], system: FromDegrees) -> None:
    """Write the observed ground as a layer of areas."""
    from pyogrio import raw

    ground = ground_within([np.array(ring, dtype=np.float64) for ring in rings])
    shapes = np.array([part for part in shapely.get_parts(ground) if part.geom_type == "Polygon"], dtype=object)
    numbers = np.arange(len(shapes), dtype=np.int64)
    raw.write(
        path,
        shapely.to_wkb(_projected(shapes, system)),
        [numbers],
        ["number"],
        layer=OBSERVED,
        driver="GPKG",
        geometry_type="Polygon",
        crs=system.name,
        append=True,
    )


def _projected(shapes: Any, system: FromDegrees) -> Any:
    """Return shapes of longitude and latitude in another system, heights as they are."""
    if system.name == WGS84:
        return shapes
    coordinates, owner = shapely.get_coordinates(shapes, include_z=True, return_index=True)
    coordinates[:, :2] = system.positions(coordinates[:, :2])
    lifted = shapely.has_z(shapes)[owner]
    found = shapes.copy()
    for mask, axes in ((lifted, 3), (~lifted, 2)):
        rows = np.unique(owner[mask])
        found[rows] = shapely.set_coordinates(found[rows], coordinates[mask, :axes])
    return found


def _write_styles(path: Path, created: str) -> None:
    """Write the table in which QGIS looks for the styles of the layers of a GeoPackage."""
    with closing(sqlite3.connect(path)) as database:
        database.execute(
            "CREATE TABLE layer_styles (id INTEGER PRIMARY KEY, f_table_catalog TEXT, f_table_schema TEXT, "
            "f_table_name TEXT, f_geometry_column TEXT, styleName TEXT, styleQML TEXT, styleSLD TEXT, "
            "useAsDefault BOOLEAN, description TEXT, owner TEXT, ui TEXT, update_time DATETIME)"
        )
        database.execute(
            "INSERT INTO gpkg_contents (table_name, data_type, identifier, last_change) "
            "VALUES ('layer_styles', 'attributes', 'layer_styles', ?)",
            [created],
        )
        for layer, style in layer_styles(LINES, CROSSINGS, OBSERVED).items():
            database.execute(
                "INSERT INTO layer_styles (f_table_catalog, f_table_schema, f_table_name, f_geometry_column, "
                "styleName, styleQML, styleSLD, useAsDefault, description, owner, ui, update_time) "
                "VALUES ('', '', ?, 'geom', 'predmapnet', ?, '', 1, '', '', '', ?)",
                [layer, style, created],
            )
        database.commit()


def _heights_text(geometry: Mapping[str, Any]) -> str | None:
    positions = geometry["coordinates"][0] if geometry["type"] == "Polygon" else geometry["coordinates"]
    return json.dumps([height for _, _, height in positions]) if len(positions[0]) == 3 else None


@contextmanager
def _plain_folder(path: Path) -> Iterator[Path]:
    """Yield a path to a file that is yet to be written, as :func:`plain_path` does for one that is there."""
    if not SPECIAL.search(str(path)):
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        link = Path(folder) / "folder"
        link.symlink_to(path.parent.resolve(), target_is_directory=True)
        yield link / path.name
