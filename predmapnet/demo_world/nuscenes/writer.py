"""Renders a world and writes it as a genuine nuScenes data set with one scene."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import orjson

from predmapnet import __version__
from predmapnet.demo_world.nuscenes.map_expansion import build_expansion, draw_prior
from predmapnet.demo_world.nuscenes.tables import LIDAR, LOCATION, build_tables, sample_file_name
from predmapnet.demo_world.render.lidar import scan
from predmapnet.demo_world.render.renderer import Renderer
from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.demo_world.world import World
from predmapnet.errors import UserError
from predmapnet.scenes import Progress, Rig

JPEG_QUALITY = 90
PRIOR_CODING = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE]
"""Of the map picture: twice as large as the smallest file, in a seventh of the time."""
ABANDONED_AFTER_SECONDS = 3600.0


def write_scene(
    world: World, folder: Path, world_version: int, rig: Rig = DEMO_RIG, progress: Progress | None = None
) -> None:
    """Render a world and write it as ``folder``, which appears at once and complete, or not at all.

    Two processes may write the same scene at the same time: the first one wins. ``world_version`` is noted in
    ``demo_world.json``, and ``progress`` is called once per key frame.

    Raises:
        UserError: the folder cannot be written.
    """
    try:
        with _appearing_at_once(folder) as draft, ThreadPoolExecutor(1) as aside:
            tables = aside.submit(_write_tables, world, draft, world_version, rig)
            _render_frames(world, draft, rig, progress)
            tables.result()
    except OSError as error:
        raise UserError(
            f"The demo scene {world.name} could not be written to {folder}: {error.strerror or error}. "
            "Free some space, or choose another folder with PREDMAPNET_CACHE."
        ) from error


@contextmanager
def _appearing_at_once(folder: Path) -> Iterator[Path]:
    """A draft folder beside ``folder`` that becomes ``folder`` in one step, and is removed after any mistake."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    prefix = f".{folder.name}-draft-"
    for abandoned in folder.parent.glob(f"{prefix}*"):
        if time.time() - abandoned.stat().st_mtime > ABANDONED_AFTER_SECONDS:
            shutil.rmtree(abandoned, ignore_errors=True)
    draft = Path(tempfile.mkdtemp(prefix=prefix, dir=folder.parent))
    draft.chmod(0o755)
    try:
        yield draft
        try:
            draft.rename(folder)
        except OSError:
            # Another process was faster; its scene is the same.
            if not folder.is_dir():
                raise
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def _write_tables(world: World, root: Path, world_version: int, rig: Rig) -> None:
    """Everything that is not a measurement: tables, map, and a note of where the scene comes from."""
    tables = build_tables(world, rig)
    for name, records in tables.items():
        _write_json(root / "v1.0-mini" / f"{name}.json", records)
    _write_json(root / "maps" / "expansion" / f"{LOCATION}.json", build_expansion(world.name, world.map))
    _write_image(root / tables["map"][0]["filename"], draw_prior(world.map), PRIOR_CODING)
    _write_json(
        root / "demo_world.json",
        {
            "synthetic": True,
            "note": f"Not a real place. '{LOCATION}' stands in the tables because the devkit knows only four names.",
            "generator": f"predmapnet {__version__}",
            "world_version": world_version,
            "scene": world.name,
            "town_seed": world.seed,
            "look": str(world.look),
        },
    )


def _render_frames(world: World, root: Path, rig: Rig, progress: Progress | None) -> None:
    """Render and encode in threads: the kernels and the encoder let go of the interpreter lock."""
    renderer = Renderer(world)
    count = len(world.trajectory.timestamps)

    def write_frame(index: int) -> None:
        timestamp = int(world.trajectory.timestamps[index])
        for channel, rendered in renderer.render_frame(rig, index).items():
            path = root / sample_file_name(world.name, channel, timestamp)
            image = np.asarray(cv2.cvtColor(rendered.image, cv2.COLOR_RGB2BGR), dtype=np.uint8)
            _write_image(path, image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        _write_bytes(
            root / sample_file_name(world.name, LIDAR, timestamp), scan(renderer, index).astype("<f4").tobytes()
        )

    _in_threads(write_frame, count, lambda done: progress(done, count, f"rendering {world.name}") if progress else None)


def _in_threads(work: Callable[[int], None], count: int, report: Callable[[int], None]) -> None:
    """Do ``work`` for 0 .. count - 1; the first mistake, or Ctrl-C, gives up what has not begun."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        futures = [pool.submit(work, index) for index in range(count)]
        try:
            for done, future in enumerate(futures, start=1):
                future.result()
                report(done)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _write_json(path: Path, content: Any) -> None:
    _write_bytes(path, orjson.dumps(content, option=orjson.OPT_INDENT_2))


def _write_image(path: Path, image: np.ndarray[Any, np.dtype[np.uint8]], options: list[int]) -> None:
    _, encoded = cv2.imencode(path.suffix, image, options)
    _write_bytes(path, encoded.tobytes())


def _write_bytes(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
