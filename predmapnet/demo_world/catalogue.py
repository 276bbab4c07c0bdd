"""The demo world's fixed scenes: which exist, what is in them, and where they are kept once rendered."""

from __future__ import annotations

import difflib
import os
import re
import sys
from functools import cache, lru_cache
from pathlib import Path

import numpy as np

from predmapnet.demo_world.first_towns import first_town
from predmapnet.demo_world.town.driving import KEY_FRAMES
from predmapnet.demo_world.town.routes import NoDriveError, drive
from predmapnet.demo_world.town.town import Town, build_town
from predmapnet.demo_world.world import Look, Trajectory, VectorMap, World
from predmapnet.errors import UserError
from predmapnet.scenes import Progress, SceneInfo

WORLD_VERSION = 5
"""Goes up whenever the same scene would come out differently; old caches are then left alone and not used."""

SPLITS: dict[str, range] = {"train": range(201, 1201), "val": range(1, 11), "test": range(101, 111)}
"""Scene numbers. Each scene has a town of its own whose seed is its number, so that no town is in two splits."""

FIRST_SPLITS: dict[str, range] = {"test": range(101, 111)}
"""Scenes of the first world that are kept, so that networks can be compared with older ones."""

LOOK_SHARES = {Look.DAY: 0.45, Look.DUSK: 0.12, Look.OVERCAST: 0.20, Look.WET: 0.13, Look.NIGHT: 0.10}
"""Probability of each look of a training scene."""

HILLY_SHARE = 0.6
"""Probability that a scene's ground has slopes; raising it changes scenes, so :data:`WORLD_VERSION` goes up with it."""

_TEN_LOOKS = (
    Look.DAY,
    Look.OVERCAST,
    Look.DAY,
    Look.WET,
    Look.DAY,
    Look.DUSK,
    Look.NIGHT,
    Look.DAY,
    Look.OVERCAST,
    Look.DAY,
)
"""Looks of the ten validation and the ten test scenes, in order: the same shares, and every look at least once."""


def splits_of(edition: int = WORLD_VERSION) -> dict[str, range]:
    """The scenes of an edition of the world: the present one has all, the first its test towns."""
    return FIRST_SPLITS if edition == 1 else SPLITS


def scene_infos(split: str | None = None, edition: int = WORLD_VERSION) -> tuple[SceneInfo, ...]:
    """List the scenes of one split, or of all. Raises UserError for a split that does not exist."""
    splits = splits_of(edition)
    if split is not None and split not in splits:
        raise UserError(f"The demo world has no split '{split}'. It has: {', '.join(splits)}.")
    return tuple(
        SceneInfo(
            name=f"scene-{number:04d}",
            split=name,
            frames=KEY_FRAMES,
            location=f"town-{number:04d}",
            ready=False,
            description=f"demo world, {look_of(f'scene-{number:04d}')}",
        )
        for name, numbers in splits.items()
        if split in (None, name)
        for number in numbers
    )


def scene_number(name: str, edition: int = WORLD_VERSION) -> int:
    """The number of a scene, which is the seed of its town. Raises UserError for a name that does not exist."""
    names = _numbers(edition)
    if name not in names:
        near = ", ".join(_nearest_names(name, names))
        raise UserError(f"The demo world has no scene '{name}'. The nearest names are: {near}.")
    return names[name]


@cache
def _numbers(edition: int) -> dict[str, int]:
    """Scene numbers of an edition by name."""
    return {f"scene-{number:04d}": number for numbers in splits_of(edition).values() for number in numbers}


def _nearest_names(name: str, names: dict[str, int]) -> list[str]:
    """By number where the name has one, otherwise by spelling."""
    digits = re.search(r"\d+", name)
    if digits:
        return sorted(names, key=lambda candidate: abs(names[candidate] - int(digits.group())))[:3]
    return difflib.get_close_matches(name, names, n=3, cutoff=0.0)


def look_of(name: str) -> Look:
    """Light and weather of a scene."""
    number = scene_number(name)
    if number not in SPLITS["train"]:
        return _TEN_LOOKS[(number - 1) % 10]
    random = np.random.default_rng([0x6C6F6F6B, number])
    return list(LOOK_SHARES)[int(random.choice(len(LOOK_SHARES), p=list(LOOK_SHARES.values())))]


@lru_cache(maxsize=32)
def _town_and_drive(number: int) -> tuple[Town, Trajectory]:
    """The first town of a seed in which there is a drive; a plan can be too cramped for its streets or for a car."""
    for attempt in range(8):
        town = build_town(number, attempt)
        try:
            return town, drive(town, number)
        except NoDriveError:
            continue
    raise NoDriveError(f"no town of seed {number} has a drive")


def town_of(name: str) -> Town:
    """The town that a scene drives through."""
    return _town_and_drive(scene_number(name))[0]


def vector_map(name: str) -> VectorMap:
    """The true map of a scene's road."""
    return town_of(name).vector_map


def trajectory(name: str) -> Trajectory:
    """The poses of the car at the key frames of a scene."""
    return _town_and_drive(scene_number(name))[1]


def build_world(name: str, edition: int = WORLD_VERSION) -> World:
    """Everything the renderer needs to draw a scene, of the present world or of the first one (edition 1)."""
    from predmapnet.demo_world.street.dressing import dress

    number = scene_number(name, edition)
    if edition == 1:
        return dress(*first_town(number), look_of(name), number, name)
    world = dress(vector_map(name), trajectory(name), look_of(name), number, name, cluttered=True)
    return hilly(world) if _is_hilly(number) else world


def hilly(world: World) -> World:
    """Return a flat world with ground that slopes, drawn from the world's seed."""
    from predmapnet.demo_world.render.ground_texture import road_of
    from predmapnet.demo_world.terrain import draw_terrain, put_on_terrain

    positions = world.trajectory.ego_to_global[:, :2, 3]
    return put_on_terrain(world, draw_terrain(world.seed, positions, road_of(world)))


def _is_hilly(number: int) -> bool:
    return np.random.default_rng([0x68696C6C79, number]).random() < HILLY_SHARE


def default_cache() -> Path:
    """The folder for things that can be made again: ``PREDMAPNET_CACHE``, or the platform's cache folder."""
    chosen = os.environ.get("PREDMAPNET_CACHE")
    if chosen:
        return Path(chosen).expanduser()
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "predmapnet"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "predmapnet"


def scene_folder(name: str, cache: Path, edition: int = WORLD_VERSION) -> Path:
    """The folder of a scene as a nuScenes data set, whether it has been rendered or not."""
    return cache / f"demo-world-v{WORLD_VERSION}{'-first-towns' if edition == 1 else ''}" / name


def ensure_scene(name: str, cache: Path, progress: Progress | None = None, edition: int = WORLD_VERSION) -> Path:
    """Render a scene (``scene-0103``) below a cache folder unless that has been done; ``progress`` hears of key frames.

    ``edition`` 1 has the towns of the first world, drawn as scenes are drawn today.

    Returns:
        The root of a nuScenes data set (``v1.0-mini``, ``samples``, ``maps``) with this one scene.

    Raises:
        UserError: the scene does not exist, or the cache cannot be written.
    """
    folder = scene_folder(name, cache, edition)
    scene_number(name, edition)
    if not folder.exists():
        from predmapnet.demo_world.nuscenes.writer import write_scene

        write_scene(build_world(name, edition), folder, WORLD_VERSION, progress=progress)
    return folder
