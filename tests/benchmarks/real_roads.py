"""Accuracy of a network on real roads: ``python -m tests.benchmarks.real_roads [--json FILE]``.

Reads what it finds below ``$PREDMAPNET_REFERENCE`` and prints one line per drive:

* every Argoverse 2 log of ``ground_truth/av2/logs``, drawn by our renderer in two looks, with the demo rig and with the
  log's own seven cameras (half size); official truth of Argoverse 2;
* every map of ``road_geometry/check``, drawn likewise, two drives along its lanes; truth by the rules of nuScenes;
* ``real_street``: real photographs, every fifth frame (five times, each beginning one frame later) and all frames;
* ``ground_truth/nuscenes_sample``: real photographs without truth (its map does not match them).

Drawn images are kept below ``$PREDMAPNET_CACHE``. What is missing is said in the table.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import orjson

from predmapnet.datasets.nuscenes import NuScenesSource
from predmapnet.demo_world.catalogue import WORLD_VERSION, default_cache
from predmapnet.errors import UserError
from predmapnet.files import check_output, write_file
from predmapnet.machine import NetworkOptions
from predmapnet.mapper import Mapper
from predmapnet.mapping import map_scene
from predmapnet.scenes import Scene
from tests.real_roads.dressed import DressedDrive, dressed_log, dressed_maps
from tests.real_roads.figures import Figures, mean_of, measure, table_head, table_row
from tests.real_roads.scene_views import ChosenFrames
from tests.real_roads.street import open_street

PROJECT = Path(__file__).resolve().parents[2]
STREET_STEP = 5
"""2 Hz of the street's 10; one drive for each frame to begin with, since 16 frames say little."""
NOTES = """
cross, div, bound: AP, mean of 0.5, 1.0, 1.5 m; c@.5: crossings at 0.5 m; lines: mean of div and bound.
along, across: recall at 1.0 m of crossings along the car's road (over side streets) and across it, from score 0.3.
P@1, R@1: whole map, length-weighted, at 1.0 m. band: true points that the 95 % band of the map's deviation holds.
map/true: crossings in the map and in the true one. A dash: nothing of the kind is true there, or none was found.
""".strip()


@dataclass(frozen=True)
class Part:
    """One line of the table before it is measured.

    Attributes:
        name: as printed, and as ``--only`` looks for it.
        group: whose mean it enters; empty for none.
        open: opens the scene; may draw for minutes.
    """

    name: str
    group: str
    open: Callable[[], Scene]


@dataclass(frozen=True)
class Missing:
    """A part that cannot be measured, and why."""

    name: str
    reason: str


def reference_folder() -> Path:
    """Return the folder of the fixtures."""
    return Path(os.environ.get("PREDMAPNET_REFERENCE", PROJECT.parent / "shared" / "reference" / "public"))


def parts(root: Path, cache: Path, step: int) -> Iterator[Part | Missing]:
    """Yield all that can be measured below ``root``, and what is missing there."""
    yield from _log_parts(root / "ground_truth" / "av2" / "logs", cache, step)
    maps = root / "road_geometry" / "check"
    if any(maps.glob("*.json")):
        yield from (_dressed("map", drive, cache, step) for drive in dressed_maps(maps))
    else:
        yield Missing("road maps", f"no *.json in {maps}")
    yield from _photograph_parts(root, step)


def _log_parts(folder: Path, cache: Path, step: int) -> Iterator[Part | Missing]:
    logs = sorted(path.parent for path in folder.glob("*/city_SE3_egovehicle.feather"))
    if not logs:
        yield Missing("Argoverse 2 logs", f"no log in {folder}")
    for log in logs:
        try:
            drives = list(dressed_log(log))
        except UserError as error:
            yield Missing(f"av2 {log.name[:8]}", str(error))
            continue
        yield from (_dressed("av2", drive, cache, step) for drive in drives)
        if all(drive.rig_name != "own" for drive in drives):
            yield Missing(f"av2 {log.name[:8]} own cameras", "the log has no calibration")


def _photograph_parts(root: Path, step: int) -> Iterator[Part | Missing]:
    street = root / "real_street"
    if (street / "truth.json").is_file():
        for start in range(STREET_STEP):
            name, group = f"street, every {STREET_STEP}th frame from {start}", f"street, every {STREET_STEP}th frame"
            yield Part(name, group, partial(_street, street, start, STREET_STEP * step))
        yield Part("street, all frames", "", partial(_street, street, 0, step))
    else:
        yield Missing("street", f"{street} holds no truth.json")
    sample = root / "ground_truth" / "nuscenes_sample"
    if (sample / "v1.0-mini").is_dir():
        source = NuScenesSource(sample)
        for info in source.scenes():
            yield Part(f"nuScenes sample {info.name}", "", partial(_without_truth, source, info.name))
    else:
        yield Missing("nuScenes sample", f"{sample} holds no v1.0-mini")


def _street(folder: Path, first: int, step: int) -> Scene:
    scene = open_street(folder)
    return ChosenFrames(scene, range(first, len(scene), step))


def _dressed(kind: str, drive: DressedDrive, cache: Path, step: int) -> Part:
    name = f"{kind} {drive.name}, {drive.look}, {drive.rig_name} rig"

    def tell(done: int, total: int) -> None:
        print(f"\r{name}: drawing frame {done} of {total} ", end="", file=sys.stderr, flush=True)

    return Part(name, f"{kind}, {drive.rig_name} rig", lambda: drive.open(cache, step, tell))


def _without_truth(source: NuScenesSource, name: str) -> Scene:
    """The sample's map is made up, so nothing true is known of its photographs."""
    scene = source.open(name)
    scene.ground_truth = None
    return scene


def run(chosen: list[Part | Missing], mapper: Mapper, say: Callable[[str], None]) -> dict[str, Any]:
    """Measure parts one after the other, say each line, and return everything for a file."""
    rows: list[tuple[Part, Figures]] = []
    missing: list[Missing] = []
    say(table_head())
    for part in chosen:
        try:
            if isinstance(part, Missing):
                raise UserError(part.reason)
            scene = part.open()
            figures = measure(scene, map_scene(scene, mapper, allow_missing_cameras=True))
        except UserError as error:
            missing.append(Missing(part.name, str(error)))
            say(f"{part.name}: MISSING, {error}")
            continue
        rows.append((part, figures))
        say(table_row(part.name, figures))
    means = {}
    for group in dict.fromkeys(part.group for part, _ in rows if part.group):
        means[group] = mean_of([figures for part, figures in rows if part.group == group])
        say(table_row(f"mean of {group}", means[group]))
    say(NOTES)
    return {
        "weights_sha256": mapper.weights_sha256,
        "world_version": WORLD_VERSION,
        "rows": {part.name: asdict(figures) for part, figures in rows},
        "means": {group: asdict(figures) for group, figures in means.items()},
        "missing": {part.name: part.reason for part in missing},
    }


def main(arguments: list[str] | None = None) -> int:
    """Print the table; write it if asked for. Returns 1 if nothing could be measured."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.real_roads", description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="write all figures to this file, too")
    parser.add_argument("--weights", type=Path, help="a .safetensors checkpoint; the shipped weights without it")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="only every N-th frame of each drive")
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="NAME", help="only lines whose name holds one of these"
    )
    options = parser.parse_args(arguments)
    try:
        if options.json:
            check_output(options.json)
        found = list(parts(reference_folder(), default_cache(), options.every))
        chosen = [part for part in found if not options.only or any(word in part.name for word in options.only)]
        if not chosen:
            names = "; ".join(part.name for part in found)
            raise UserError(f"No line's name holds {' or '.join(options.only)}. There are: {names}.")
        mapper = Mapper.from_checkpoint(NetworkOptions(weights=options.weights))
        result = run(chosen, mapper, lambda line: print(line, flush=True))
        if options.json:
            with write_file(options.json) as draft:
                draft.write_bytes(orjson.dumps(result | {"every": options.every}, option=orjson.OPT_INDENT_2))
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0 if result["rows"] else 1


if __name__ == "__main__":
    sys.exit(main())
