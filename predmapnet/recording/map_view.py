"""Finished maps in Rerun, without the drives that made them: one, several at once, or what changed between two."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rerun as rr

from mapfusion.arrays import Float
from mapfusion.colours import CHANGE_COLOURS
from mapfusion.diff import Change, MapDiff, diff_maps
from mapfusion.diff_files import read_diff
from mapfusion.elements import ElementKind, GlobalMap
from mapfusion.formats.by_suffix import frame_of, read_maps
from mapfusion.formats.identities import all_named
from mapfusion.formats.local_plane import LocalPlane
from mapfusion.merge.report import short_names
from mapfusion.provenance import united_provenance
from predmapnet.errors import UserError
from predmapnet.recording.blueprint import Extent, map_blueprint
from predmapnet.recording.map_lines import WORLD_COORDINATES, lifted, log_on_earth, map_lines

OBSERVED_COLOUR = (52, 58, 72)
COLOUR_WORDS = {
    "added": "white",
    "removed": "red",
    "moved": "violet",
    "unchanged": "grey",
    "unobserved": "dark violet",
}


def log_maps(recording: rr.RecordingStream, paths: Sequence[Path]) -> list[str]:
    """Draw maps of one place, of any formats, in metres east and north of their middle.

    Returns:
        Notes of the readers, for the user.

    Raises:
        UserError: a file cannot be read or is no map, the maps do not lie in one place, or hold no elements.
    """
    maps, plane, origin = _begin(recording, paths)
    for name, found in zip(short_names(paths), maps, strict=True):
        inside = "map" if len(maps) == 1 else f"maps/{rr.escape_entity_path_part(name)}"
        for kind in ElementKind:
            recording.log(f"world/{inside}/{kind.label}", map_lines(found.of_kind(kind), origin, 1.8), static=True)
        rings = [lifted(plane.from_wgs84(np.array(ring)) - origin, -0.1) for ring in _observed(found)]
        border = rr.LineStrips3D(rings, colors=OBSERVED_COLOUR, radii=rr.Radius.ui_points(1.0))
        recording.log(f"world/{inside}/observed_ground", border, static=True)
        if _on_earth(maps):
            log_on_earth(recording, f"earth/{inside}", found, plane)
    rows = [
        f"- {kind.nouns}: {sum(len(found.of_kind(kind)) for found in maps)}, "
        f"{sum(found.length(kind) for found in maps):,.0f} m"
        for kind in ElementKind
    ]
    title = paths[0].name if len(paths) == 1 else f"{len(paths)} maps"
    colours = "Blue crossings, orange dividers, green boundaries, the darker the less confident; thin: ground observed."
    _describe(recording, title, maps, [*rows, "", colours])
    return _notes(paths, maps)


def log_changes(recording: rr.RecordingStream, paths: Sequence[Path]) -> list[str]:
    """Draw what changed from the first of two maps to the second, as ``predmapnet diff`` finds it.

    Returns and raises as :func:`log_maps`.
    """
    maps, plane, origin = _begin(recording, paths)
    found = diff_maps(maps[0], maps[1], plane)
    _draw_changes(recording, found, origin)
    _describe(recording, f"{paths[0].name} → {paths[1].name}", maps, _changes(found))
    return _notes(paths, maps)


def log_differences(recording: rr.RecordingStream, path: Path) -> list[str]:
    """Draw a file that ``predmapnet diff`` wrote. Returns and raises as :func:`log_maps`."""
    try:
        found, _, told = read_diff(path)
    except FileNotFoundError:
        raise
    except (OSError, ValueError) as error:
        raise UserError(f"cannot show {path}: {error}") from error
    if not found.differences:
        raise UserError(f"{path}: it holds no differences, so there is nothing to look at")
    points = np.concatenate([item.points for item in found.differences])
    recording.send_blueprint(map_blueprint(Extent.of(points, 5.0), on_earth=False))
    recording.log("world", WORLD_COORDINATES, static=True)
    _draw_changes(recording, found, np.zeros(2))
    title = " → ".join(str(told[name]) for name in ("old", "new") if name in told) or path.name
    _describe(recording, title, [GlobalMap((), told)], _changes(found))
    return []


def _draw_changes(recording: rr.RecordingStream, found: MapDiff, origin: Float) -> None:
    for change in Change:
        for kind in ElementKind:
            stretches = [item for item in found.differences if item.change is change and item.kind is kind]
            moved = ("" if np.isnan(item.moved_by) else f", {item.moved_by:.2f} m off" for item in stretches)
            lines = rr.LineStrips3D(
                [lifted(item.points - origin, 0.0 if change is Change.UNCHANGED else 0.1) for item in stretches],
                colors=CHANGE_COLOURS[change],
                radii=rr.Radius.ui_points(1.2 if change in (Change.UNCHANGED, Change.UNOBSERVED) else 2.4),
                labels=[
                    f"{change} {kind.noun}, {item.length:.0f} m, confidence {item.confidence:.2f}{off}"
                    for item, off in zip(stretches, moved, strict=True)
                ],
                show_labels=False,
            )
            recording.log(f"world/{change}/{kind.label}", lines, static=True)


def _begin(recording: rr.RecordingStream, paths: Sequence[Path]) -> tuple[list[GlobalMap], LocalPlane, Float]:
    """Read the maps and lay out the view; returns them with their plane and the middle of them all, metres."""
    try:
        maps, plane = read_maps(paths)
    except FileNotFoundError:
        raise
    except (OSError, ValueError) as error:
        raise UserError(f"cannot show {', '.join(map(str, paths[:3]))}: {error}") from error
    points = [element.points for found in maps for element in found]
    if not points:
        raise UserError(f"{', '.join(map(str, paths[:3]))}: no map elements, so there is nothing to look at")
    together = np.concatenate(points)
    origin = (together.min(axis=0) + together.max(axis=0)) / 2
    recording.send_blueprint(map_blueprint(Extent.of(together - origin, 5.0), _on_earth(maps)))
    recording.log("world", WORLD_COORDINATES, static=True)
    named = [GlobalMap(tuple(all_named(found)), found.provenance, found.notes) for found in maps]
    return named, plane, origin


def _on_earth(maps: Sequence[GlobalMap]) -> bool:
    """Whether the maps lie where they say: a synthetic one and one of an unknown place do not."""
    return not any(found.provenance.get("synthetic") or frame_of(found) for found in maps)


def _observed(found: GlobalMap) -> Sequence[Sequence[Sequence[float]]]:
    return found.provenance.get("observed") or ()


def _changes(found: MapDiff) -> list[str]:
    rows = ["| | pieces | metres | |", "| --- | ---: | ---: | --- |"]
    for change in Change:
        pieces = sum(found.count(change, kind) for kind in ElementKind)
        metres = sum(found.metres(change, kind) for kind in ElementKind)
        rows.append(f"| {change} | {pieces} | {metres:,.0f} | {COLOUR_WORDS[change]} |")
    return rows


def _describe(recording: rr.RecordingStream, title: str, maps: Sequence[GlobalMap], rows: Sequence[str]) -> None:
    note = united_provenance(found.provenance for found in maps).get("note", "")
    text = "\n".join([f"# {title}", "", *rows, "", "Metres, north is up.", "", str(note)])
    recording.log("description", rr.TextDocument(text, media_type="text/markdown"), static=True)


def _notes(paths: Sequence[Path], maps: Sequence[GlobalMap]) -> list[str]:
    return [f"{path}: {note}" for path, found in zip(paths, maps, strict=True) for note in found.notes]
