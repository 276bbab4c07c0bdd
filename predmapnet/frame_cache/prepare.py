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
from predmapnet.frame_cache.scene_cache import INDEX, CachedScene, TrainingScenes, cache_folder
from predmapnet.scenes import Report, SceneInfo, SceneSource
from predmapnet.sources import DATASETS, open_source

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
        source, sentence, *parts = _chosen_scenes(chosen, options)
        learned, measured = ([info.name for info in part] for part in parts)
        if source is None:
            folder = cache_folder(options.cache, f"{DEMO}-v{WORLD_VERSION}", config)
            fill_with_demo(folder, learned + measured, config, processes, report)
        else:
            place = sha256(str(source.root.resolve()).encode()).hexdigest()[:8]
            folder = cache_folder(options.cache, f"{source.name}-{place}", config)
            report(f"{sentence} {len(learned)} scenes to train on, {len(measured)} to validate on.")
            fill_from_source(source, learned + measured, folder, config, processes, report)
        train |= {folder / name: chosen.weight for name in learned if (folder / name / INDEX).exists()}
        validation += [folder / name for name in measured if (folder / name / INDEX).exists()]
    if not train:
        raise UserError(f"There is no scene to train on in {options}.")
    scenes = TrainingScenes([CachedScene(folder) for folder in train], list(train.values()), config)
    return scenes, [CachedScene(folder) for folder in validation]


def count_frames(options: DataOptions, config: PredMapNetConfig) -> tuple[int, int]:
    """Return how many frames an epoch has, and about how many images the cache will hold; nothing is made.

    Raises:
        UserError: data are not there.
    """
    total, images, any_car = 0.0, 0, isinstance(config.bev, LookupBevConfig)
    for chosen in options.sets:
        source, _, learned, measured = _chosen_scenes(chosen, options)
        infos = learned + measured
        if source is None:
            cameras = [len(training_rig(info.name, any_car)) for info in infos]
        else:
            cameras = [len(source.open(info.name).rig) for info in infos[:1]] * len(infos)
        total += chosen.weight * sum(info.frames for info in learned)
        images += sum(info.frames * count for info, count in zip(infos, cameras, strict=True))
    return round(total), images


def _chosen_scenes(
    chosen: DataSet, options: DataOptions
) -> tuple[SceneSource | None, str, list[SceneInfo], list[SceneInfo]]:
    """Open a data set (None: towns, which are drawn), with a sentence for users; scenes to learn and to validate."""
    if chosen.name == DEMO:
        return None, "", _towns("train", options.towns), _towns("val", options.validation)
    source, sentence = open_source(chosen.name, chosen.root, options.split_scheme)
    return source, sentence, *_split(source.scenes(), options.validation)


def _towns(split: str, count: int) -> list[SceneInfo]:
    infos = scene_infos(split)
    if count > len(infos):
        raise UserError(f"The demo world has {len(infos)} {split} scenes, not {count}.")
    return list(infos[:count])


def _split(infos: Sequence[SceneInfo], validation: int) -> tuple[list[SceneInfo], list[SceneInfo]]:
    """Scenes to train on and to validate on; logs that no split knows are trained on, all of them."""
    skipped = {*split_names("nuscenes_skipped"), *split_names("argoverse2_skipped")}
    train, measured, others = (
        [info for info in infos if info.split == split and info.name not in skipped]
        for split in ("train", "val", "test")
    )
    if not train and not measured:
        return others, []
    spread = np.unique(np.linspace(0, len(measured) - 1, min(validation, len(measured))).round().astype(int))
    return train, [measured[index] for index in spread]
