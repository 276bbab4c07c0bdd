"""The data of a run: which data sets, which of their scenes, and their place in the training cache."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

import numpy as np

from predmapnet.config import LookupBevConfig, PredMapNetConfig
from predmapnet.datasets.splits import split_names
from predmapnet.demo_world.catalogue import WORLD_VERSION, scene_infos
from predmapnet.demo_world.source import DEMO
from predmapnet.demo_world.training_drive import training_rig
from predmapnet.errors import UserError
from predmapnet.frame_cache.fill_cache import fill_from_source, fill_with_demo
from predmapnet.frame_cache.scene_cache import INDEX, CachedScene, cache_folder
from predmapnet.scenes import Report, SceneInfo
from predmapnet.sources import DATASETS, open_source
from predmapnet.training.data.draws import TrainingScenes

PreparedData = tuple[TrainingScenes, list[CachedScene]]
"""Scenes that are trained on, and those that are validated on."""
TRAINABLE = tuple(name for name in DATASETS if name != "demo-v1")


@dataclass(frozen=True)
class DataSet:
    """One data set of a run.

    Attributes:
        name: ``nuscenes``, ``argoverse2``, ``demo`` or ``log``.
        root: its folder; None asks the environment. The demo world has none.
        weight: how often each of its frames is seen in an epoch.
    """

    name: str
    root: Path | None = None
    weight: float = 1.0


@dataclass(frozen=True)
class DataOptions:
    """Data that a user chooses.

    Attributes:
        sets: the data sets.
        cache: folder of the training caches.
        towns: training scenes of the demo world.
        validation: most validation scenes of each data set.
        split_scheme: ``old`` or ``new``, of nuScenes and Argoverse 2.
    """

    sets: tuple[DataSet, ...]
    cache: Path
    towns: int = 160
    validation: int = 10
    split_scheme: str = "old"

    def __str__(self) -> str:
        return ", ".join(chosen.name + (f":{chosen.weight:g}" if chosen.weight != 1 else "") for chosen in self.sets)


def parse_data_sets(names: Sequence[str], roots: Sequence[Path] = ()) -> tuple[DataSet, ...]:
    """Read what a user typed.

    Args:
        names: of data sets, each with ``:weight`` behind it or not.
        roots: folders, in the order of the data sets other than the demo world; none asks the environment.

    Raises:
        UserError: an unknown name, a weight that is none, or too few or too many folders.
    """
    folders = list(roots)
    found: list[DataSet] = []
    for text in names:
        name, _, weight = text.partition(":")
        if name not in TRAINABLE:
            raise UserError(f"There is no training data '{name}'. Choose: {', '.join(TRAINABLE)}.")
        try:
            times = float(weight or 1)
        except ValueError:
            times = 0.0
        if not 0 < times < np.inf:
            raise UserError(f"'{weight}' in --data {text} is no weight: give a number above 0, as in {name}:3.")
        needs_root = name != DEMO and bool(roots)
        if needs_root and not folders:
            raise UserError(f"There is no --data-root for {name}: give one for each data set but demo, in their order.")
        found.append(DataSet(name, folders.pop(0) if needs_root else None, times))
    if folders:
        raise UserError(f"No --data belongs to --data-root {folders[0]}: name one data set for each folder.")
    return tuple(found)


def prepare_data(
    options: DataOptions, config: PredMapNetConfig, processes: int, report: Report = print
) -> PreparedData:
    """Bring all scenes of a run into the cache, so many ``processes`` side by side.

    Raises:
        UserError: a data set is missing or broken, or there is nothing to train on.
    """
    train: dict[Path, float] = {}
    validation: list[Path] = []
    for chosen in options.sets:
        folder, learned, measured = _prepare(chosen, options, config, processes, report)
        train |= {folder / name: chosen.weight for name in learned if (folder / name / INDEX).exists()}
        validation += [folder / name for name in measured if (folder / name / INDEX).exists()]
    if not train:
        raise UserError(f"There is no scene to train on in {options}.")
    scenes = TrainingScenes([CachedScene(folder) for folder in train], list(train.values()), config)
    return scenes, [CachedScene(folder) for folder in validation]


def _prepare(
    chosen: DataSet, options: DataOptions, config: PredMapNetConfig, processes: int, report: Report
) -> tuple[Path, list[str], list[str]]:
    """Fill the cache of one data set; return its folder, and names of training and validation scenes."""
    if chosen.name == DEMO:
        folder = cache_folder(options.cache, f"{DEMO}-v{WORLD_VERSION}", config)
        learned, measured = _demo_names("train", options.towns), _demo_names("val", options.validation)
        fill_with_demo(folder, learned + measured, config, processes, report)
        return folder, learned, measured
    source, sentence = open_source(chosen.name, chosen.root, options.split_scheme)
    place = sha256(str(source.root.resolve()).encode()).hexdigest()[:8]
    folder = cache_folder(options.cache, f"{source.name}-{place}", config)
    learned, measured = _names(source.scenes(), options.validation)
    report(f"{sentence} {len(learned)} scenes to train on, {len(measured)} to validate on.")
    fill_from_source(source, learned + measured, folder, config, processes, report)
    return folder, learned, measured


def count_frames(options: DataOptions, config: PredMapNetConfig) -> tuple[int, int]:
    """Return how many frames an epoch has, and about how many images the cache will hold; nothing is made.

    Raises:
        UserError: data are not there.
    """
    total, images, any_car = 0.0, 0, isinstance(config.bev, LookupBevConfig)
    for chosen in options.sets:
        if chosen.name == DEMO:
            infos = (*scene_infos("train"), *scene_infos("val"))
            learned, measured = _demo_names("train", options.towns), _demo_names("val", options.validation)
            cameras = [len(training_rig(name, any_car)) for name in learned + measured]
        else:
            source, _ = open_source(chosen.name, chosen.root, options.split_scheme)
            infos = tuple(source.scenes())
            learned, measured = _names(infos, options.validation)
            cameras = [len(source.open(name).rig) for name in (learned + measured)[:1]] * len(learned + measured)
        frames = {info.name: info.frames for info in infos}
        total += chosen.weight * sum(frames[name] for name in learned)
        images += sum(frames[name] * count for name, count in zip(learned + measured, cameras, strict=True))
    return round(total), images


def _demo_names(split: str, count: int) -> list[str]:
    names = [info.name for info in scene_infos(split)]
    if count > len(names):
        raise UserError(f"The demo world has {len(names)} {split} scenes, not {count}.")
    return names[:count]


def _names(infos: Sequence[SceneInfo], validation: int) -> tuple[list[str], list[str]]:
    """Names of training and validation scenes; logs that no split knows are trained on, all of them."""
    skipped = {*split_names("nuscenes_skipped"), *split_names("argoverse2_skipped")}
    by_split = {
        split: [info.name for info in infos if info.split == split and info.name not in skipped]
        for split in ("train", "val", "test")
    }
    measured = by_split["val"]
    spread = np.unique(np.linspace(0, len(measured) - 1, min(validation, len(measured))).round().astype(int))
    if not by_split["train"] and not measured:
        return by_split["test"], []
    return by_split["train"], [measured[index] for index in spread]
