"""Choice of the scenes of a batch: by name or pattern, by split, or from a manifest that says where each one lies."""

from __future__ import annotations

import csv
import difflib
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING

from predmapnet.errors import UserError

if TYPE_CHECKING:
    from predmapnet.scenes import SceneSource

MANIFEST_ENDINGS = (".csv", ".parquet")


@dataclass(frozen=True)
class ListedScene:
    """Name of a scene, and the folder of its data set; None for the one that the batch is told.

    Example:
        >>> str(ListedScene("scene-0103", Path("/data/monday")))
        'scene-0103'
    """

    name: str
    root: Path | None = None

    def __str__(self) -> str:
        return self.name


def choose_scenes(source: SceneSource, names: Sequence[str], split: str | None) -> list[ListedScene]:
    """Return the scenes to map: those that names or patterns (``scene-00*``) mean, or all of a split, or all.

    Raises:
        UserError: a name, a pattern or a split means no scene (with the nearest names), or there is nothing to map.
    """
    known = [scene.name for scene in source.scenes(split)]
    there = f"{source.name}{f', split {split}' if split else ''}"
    if not known:
        raise UserError(f"there is no scene to map in {there}")
    chosen = [] if names else known
    for name in names:
        found = [name] if name in known else [scene for scene in known if fnmatchcase(scene, name)]
        if not found:
            near = difflib.get_close_matches(name, known, n=3, cutoff=0.4)
            hint = f"; did you mean {', '.join(near)}?" if near else ""
            raise UserError(f"there is no scene '{name}' in {there}{hint}")
        chosen.extend(found)
    return [ListedScene(name) for name in dict.fromkeys(chosen)]


def read_manifest(path: Path) -> list[ListedScene]:
    """Return the scenes of a manifest: a CSV or Parquet file with the columns ``scene`` and ``folder``.

    A folder that is not absolute lies beside the manifest.

    Raises:
        UserError: it cannot be read, lacks a column or a value, names no scene or one twice.
    """
    rows = _csv_rows(path) if path.suffix.lower() == ".csv" else _parquet_rows(path)
    scenes: dict[str, ListedScene] = {}
    for number, (scene, folder) in enumerate(rows, start=1):
        if not scene or not folder:
            raise UserError(f"{path}, row {number}: it takes a scene and a folder, but one is empty")
        if scene in scenes:
            raise UserError(f"{path}, row {number}: {scene} is there twice, and its map can only have one name")
        scenes[scene] = ListedScene(scene, path.parent / Path(folder).expanduser())
    if not scenes:
        raise UserError(f"{path} names no scene")
    return list(scenes.values())


def _csv_rows(path: Path) -> list[tuple[str, str]]:
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file)
            _check_columns(path, reader.fieldnames or ())
            return [((row["scene"] or "").strip(), (row["folder"] or "").strip()) for row in reader]
    except (UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"{path} is no CSV file: {error}") from error


def _parquet_rows(path: Path) -> list[tuple[str, str]]:
    from predmapnet.arrow_tables import open_parquet, parquet_rows

    file = open_parquet(path)
    _check_columns(path, file.schema_arrow.names)
    rows = parquet_rows(path, file, ["scene", "folder"])
    return [(str(row["scene"] or "").strip(), str(row["folder"] or "").strip()) for row in rows]


def _check_columns(path: Path, names: Sequence[str]) -> None:
    missing = [name for name in ("scene", "folder") if names.count(name) != 1]
    if missing:
        raise UserError(
            f"{path} has no column {' or '.join(missing)}, or has it twice; a manifest has the columns scene and folder"
        )
