"""A finished map in Rerun, without the drive that made it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr

from mapfusion.colours import KIND_COLOURS
from mapfusion.elements import ElementKind, GlobalMap
from mapfusion.formats.by_suffix import read_map
from predmapnet.errors import UserError
from predmapnet.recording.blueprint import WORLD_COORDINATES, map_blueprint


def log_map_file(recording: rr.RecordingStream, path: Path) -> None:
    """Draw a map of any format that ``predmapnet infer`` writes, in metres east and north of its middle.

    Raises UserError for a file that cannot be read, is no map of ours, or holds no elements.
    """
    try:
        global_map = read_map(path)
    except (OSError, ValueError) as error:
        raise UserError(f"cannot show {path}: {error}") from error
    if len(global_map) == 0:
        raise UserError(f"{path} holds no map elements: there is nothing to look at")
    points = np.concatenate([element.points for element in global_map])
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    extent = float(np.ptp(points, axis=0).max())
    recording.send_blueprint(map_blueprint((middle[0], middle[1]), max(extent, 20.0)))
    recording.log("world", WORLD_COORDINATES, static=True)
    text = rr.TextDocument(_summary(path, global_map), media_type="text/markdown")
    recording.log("description", text, static=True)
    for kind in ElementKind:
        elements = global_map.of_kind(kind)
        lines = rr.LineStrips3D(
            [np.column_stack([element.points, np.zeros(len(element.points))]) for element in elements],
            colors=KIND_COLOURS[kind],
            radii=rr.Radius.ui_points(1.8),
            labels=[f"{kind.label}  confidence {element.confidence:.2f}" for element in elements],
            show_labels=False,
        )
        recording.log(f"world/map/{kind.label}", lines, static=True)


def _summary(path: Path, global_map: GlobalMap) -> str:
    rows = "\n".join(
        f"- {kind.label}: {len(global_map.of_kind(kind))} elements, {global_map.length(kind):.0f} m"
        for kind in ElementKind
    )
    note = "\n\n".join([str(global_map.provenance.get("note", "")), *global_map.notes])
    return (
        f"# {path.name}\n\n{note}\n\n{rows}\n\nMetres, north is up: blue crossings, orange dividers, green boundaries."
    )
