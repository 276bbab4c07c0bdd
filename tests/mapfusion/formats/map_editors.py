"""Edits of map files as programs make them: a vertex moved, an element deleted, one added; one function a format."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree

import msgpack
import numpy as np
import pyarrow as pa
import pyogrio
import shapely
from pyogrio import raw

from mapfusion.formats.local_plane import LocalPlane

ADDED = np.array([[0.0, 40.0], [60.0, 40.0]])
"""The divider that every editor adds, metres."""

SHIFT = np.array([0.0, 4.0])
"""Where the middle vertex of the boundary goes, metres."""


def edit_with_gdal(path: Path, plane: LocalPlane) -> None:
    """Rewrite all layers as GDAL and QGIS do: the metadata is lost, an added row has no attributes but its kind."""
    layers = [name for name, geometry in pyogrio.list_layers(path) if geometry is not None]
    tables = []
    for layer in layers:
        meta, _, geometry, columns = raw.read(path, layer=layer)
        tables.append((layer, list(meta["fields"]), shapely.from_wkb(geometry), list(columns), meta["geometry_type"]))
    path.unlink()
    driver = {".geojson": "GeoJSON", ".gpkg": "GPKG", ".fgb": "FlatGeobuf"}[path.suffix]
    for layer, names, shapes, columns, geometry_type in tables:
        if layer != "observed":
            ids = columns[names.index("id")]
            keep = ids != "gone"
            pairs = zip(ids[keep], shapes[keep], strict=True)
            shapes = np.array([_bent(shape, plane) if name == "kerb" else shape for name, shape in pairs])
            columns = [column[keep] for column in columns]
        if layer not in ("observed", "crossings"):
            shapes = np.append(shapes, shapely.LineString(plane.to_wgs84(ADDED)))
            columns = [np.append(column, _blank(name, column)) for name, column in zip(names, columns, strict=True)]
        raw.write(
            path, shapely.to_wkb(shapes), columns, names, layer=layer, driver=driver, crs="EPSG:4326",
            geometry_type=geometry_type if driver != "FlatGeobuf" else "Unknown",
            append=driver == "GPKG" and path.exists(),
        )  # fmt: skip


def _bent(shape, plane: LocalPlane):
    points = shapely.get_coordinates(shape)
    points[1] = plane.to_wgs84(plane.from_wgs84(points[1:2]) + SHIFT)[0]
    return shapely.LineString(points)


def _blank(name: str, column):
    """What a row drawn by hand has: nothing, but the kind that the person chose."""
    if name == "kind":
        return np.array(["divider"], dtype=object)
    if column.dtype.kind == "M":
        return np.array(["NaT"], dtype=column.dtype)
    return np.array([None if column.dtype == object else 0 if column.dtype.kind == "i" else np.nan], dtype=column.dtype)


def edit_with_josm(path: Path, plane: LocalPlane) -> None:
    """Mark and add what JOSM does: ``action``, negative ids."""
    tree = ElementTree.parse(path)
    root = tree.getroot()
    nodes = {node.attrib["id"]: node for node in root.iter("node")}
    for way in root.findall("way"):
        tags = {tag.attrib["k"]: tag.attrib["v"] for tag in way.iter("tag")}
        if tags.get("predmapnet:id") == "gone":
            way.set("action", "delete")
        if tags.get("predmapnet:id") == "kerb":
            node = nodes[way.findall("nd")[1].attrib["ref"]]
            place = np.array([[float(node.attrib["lon"]), float(node.attrib["lat"])]])
            longitude, latitude = plane.to_wgs84(plane.from_wgs84(place) + SHIFT)[0]
            node.attrib.update(lon=str(longitude), lat=str(latitude), action="modify")
    way = ElementTree.SubElement(root, "way", id="-9", action="modify")
    for number, (longitude, latitude) in enumerate(plane.to_wgs84(ADDED)):
        ElementTree.SubElement(root, "node", id=f"-{number + 1}", lon=str(longitude), lat=str(latitude))
        ElementTree.SubElement(way, "nd", ref=f"-{number + 1}")
    ElementTree.SubElement(way, "tag", k="type", v="line_thin")
    tree.write(path)


def edit_roads(path: Path, plane: LocalPlane) -> None:
    """Edit the roads of an OpenDRIVE file; its metres are those of the plane."""
    tree = ElementTree.parse(path)
    root = tree.getroot()
    for road in root.findall("road"):
        if road.attrib["name"] == "gone":
            root.remove(road)
        if road.attrib["name"] == "kerb":
            pieces = road.findall("planView/geometry")
            ends = [[float(piece.attrib[name]) for name in ("x", "y")] for piece in pieces]
            last = pieces[-1].attrib
            reach = float(last["length"]) * np.array([np.cos(float(last["hdg"])), np.sin(float(last["hdg"]))])
            points = np.array([*ends, ends[-1] + reach])
            points[1] += SHIFT
            _lay(pieces, points)
    road = ElementTree.SubElement(root, "road", name="mine", id="1", junction="-1", length="60")
    _lay([ElementTree.SubElement(ElementTree.SubElement(road, "planView"), "geometry")], ADDED)
    section = ElementTree.SubElement(ElementTree.SubElement(road, "lanes"), "laneSection", s="0")
    lane = ElementTree.SubElement(ElementTree.SubElement(section, "center"), "lane", id="0")
    ElementTree.SubElement(lane, "roadMark", sOffset="0", type="broken", color="standard")
    tree.write(path)


def _lay(pieces, points) -> None:
    """Lay straight pieces along points."""
    steps = np.diff(points, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    for piece, start, step, length, station in zip(
        pieces, points, steps, lengths, np.cumsum(lengths) - lengths, strict=False
    ):
        values = {"s": station, "x": start[0], "y": start[1], "hdg": np.arctan2(step[1], step[0]), "length": length}
        piece.attrib.update({name: repr(float(value)) for name, value in values.items()})
        if piece.find("line") is None:
            ElementTree.SubElement(piece, "line")


def edit_nuscenes(path: Path, plane: LocalPlane) -> None:
    """Edit the layers of a map expansion."""
    document = json.loads(path.read_text())
    document["lane_divider"] = [d for d in document["lane_divider"] if d["predmapnet"]["id"] != "gone"]
    (kerb,) = document["road_boundary"]
    line = next(line for line in document["line"] if line["token"] == kerb["line_token"])
    node = next(node for node in document["node"] if node["token"] == line["node_tokens"][1])
    node["y"] += SHIFT[1]
    document["node"] += [{"token": f"n{row}", "x": x, "y": y} for row, (x, y) in enumerate(ADDED.tolist())]
    document["line"].append({"token": "l", "node_tokens": ["n0", "n1"]})
    document["road_divider"].append({"token": "d", "line_token": "l", "road_segment_token": ""})
    path.write_text(json.dumps(document))


def edit_argoverse2(path: Path, plane: LocalPlane) -> None:
    """Edit the lane segments of an archive; the added one is a lane whose two boundaries are one line."""
    document = json.loads(path.read_text())
    lanes = document["lane_segments"]
    for number, lane in list(lanes.items()):
        if lane["predmapnet"]["id"] == "gone":
            del lanes[number]
        if lane["predmapnet"]["id"] == "kerb":
            lane["left_lane_boundary"][1]["y"] += SHIFT[1]
    points = [{"x": x, "y": y, "z": 0.0} for x, y in ADDED.tolist()]
    away = [{**point, "y": point["y"] + 3.5} for point in points]
    lanes["7"] = {"id": 7, "left_lane_boundary": away, "right_lane_boundary": points}
    path.write_text(json.dumps(document))


def edit_py123d(path: Path, plane: LocalPlane) -> None:
    """Edit the rows of a py123d map; the added one is a road line (layer 9) as py123d writes it."""
    table = pa.ipc.open_file(path.read_bytes()).read_all()
    rows = [row for row in table.to_pylist() if b'"gone"' not in row["features"]]
    for row in rows:
        if b'"kerb"' in row["features"]:
            points = shapely.get_coordinates(shapely.from_wkb(row["wkb"]), include_z=True)
            points[1, :2] += SHIFT
            row["wkb"] = shapely.to_wkb(shapely.LineString(points))
    line = shapely.LineString(np.column_stack([ADDED, np.zeros(2)]))
    features = msgpack.packb({"road_line_type": 11})
    rows.append({"object_id": 7, "map_layer": 9, "features": features, "wkb": shapely.to_wkb(line)})
    lane = {"object_id": 8, "map_layer": 0, "features": msgpack.packb({}), "wkb": shapely.to_wkb(line.buffer(2.0))}
    with pa.ipc.new_file(str(path), table.schema) as file:
        file.write_table(pa.Table.from_pylist([*rows, lane], schema=table.schema))


EDITORS = {
    ".geojson": edit_with_gdal,
    ".gpkg": edit_with_gdal,
    ".fgb": edit_with_gdal,
    ".osm": edit_with_josm,
    ".xodr": edit_roads,
    ".nuscenes.json": edit_nuscenes,
    ".argoverse2.json": edit_argoverse2,
    ".arrow": edit_py123d,
}
