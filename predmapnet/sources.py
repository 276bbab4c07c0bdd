"""Choice of the data set: by option, environment or folder; the demo world when nothing is configured.

Environment variables, each used only where the command line says nothing:

* ``PREDMAPNET_DATASET``: ``nuscenes``, ``argoverse2``, ``log``, ``demo`` or ``demo-v1``.
* ``PREDMAPNET_DATA_ROOT``: folder of the data set.
* ``NUSCENES_ROOT``, ``AV2_ROOT``: the customary names of the field, looked at last.
"""

from __future__ import annotations

import os
from pathlib import Path

from predmapnet.datasets.argoverse2 import Argoverse2Source
from predmapnet.datasets.argoverse2_files import find_logs
from predmapnet.datasets.nuscenes import NuScenesSource
from predmapnet.datasets.nuscenes_tables import find_versions
from predmapnet.datasets.own_logs.source import LogSource, find_own_logs
from predmapnet.datasets.splits import check_scheme
from predmapnet.demo_world.source import DemoSource
from predmapnet.errors import UserError
from predmapnet.scenes import SceneSource

DATASETS = ("nuscenes", "argoverse2", "log", "demo", "demo-v1")
ROOT_VARIABLES = {"nuscenes": "NUSCENES_ROOT", "argoverse2": "AV2_ROOT"}


def open_source(
    dataset: str | None = None,
    data_root: Path | None = None,
    split_scheme: str = "old",
    official_frames: bool = False,
    rate: float | None = None,
) -> tuple[SceneSource, str]:
    """Open a data set.

    Args:
        dataset: ``nuscenes``, ``argoverse2``, ``log``, ``demo`` or ``demo-v1``; None asks the environment, then the
            folder itself.
        data_root: folder of the data set (for the demo world: its cache); None asks the environment.
        split_scheme: ``old`` (the data set's own splits) or ``new`` (StreamMapNet's geographically disjoint ones).
        official_frames: of Argoverse 2, take exactly the frames of the published benchmarks instead of counting the
            sweeps of each log from 0. nuScenes has only one kind of frames.
        rate: of logs of one's own, frames a second; None takes 2.

    Returns:
        The source, and a sentence for users: which data set it is and why.

    Raises:
        UserError: the data set is missing or broken; there is no silent fallback.
    """
    check_scheme(split_scheme)
    source, sentence = _open(dataset, data_root, split_scheme, official_frames, rate)
    if isinstance(source, DemoSource) and split_scheme == "new":
        raise UserError("The demo world has no new split: each of its scenes has a town of its own anyway.")
    if isinstance(source, LogSource) and split_scheme == "new":
        raise UserError("Logs of one's own have no new split.")
    if rate is not None and not isinstance(source, LogSource):
        raise UserError(f"--rate is for logs of one's own; the frames of {source.name} are given.")
    if official_frames and not isinstance(source, Argoverse2Source):
        raise UserError(f"Official frames are a matter of Argoverse 2; {source.name} has only one kind of frames.")
    if split_scheme == "new":
        sentence += " Splits are the new, geographically disjoint ones."
    return source, sentence


def _open(
    dataset: str | None, data_root: Path | None, split_scheme: str, official_frames: bool, rate: float | None
) -> tuple[SceneSource, str]:
    dataset, dataset_from = _setting(dataset, "--dataset", "PREDMAPNET_DATASET")
    root_text, root_from = _setting(data_root, "--data-root", "PREDMAPNET_DATA_ROOT")
    if dataset is not None and dataset not in DATASETS:
        raise UserError(f"{dataset_from} says '{dataset}', but the data sets are: {', '.join(DATASETS)}.")
    if dataset in ("demo", "demo-v1"):
        cache = None if root_text is None else Path(root_text).expanduser()
        if dataset == "demo-v1":
            return DemoSource(cache, edition=1), f"Using the towns of the first demo world, as {dataset_from} says."
        return DemoSource(cache), f"Using the demo world (synthetic towns), as {dataset_from} says."
    if root_text is None:
        dataset, dataset_from, root_text, root_from = _customary_root(dataset, dataset_from)
    if root_text is None:
        if dataset is not None:
            raise UserError(
                f"{dataset_from} asks for {dataset}, but nothing says where it lies: give --data-root, or set "
                f"PREDMAPNET_DATA_ROOT{' or ' + ROOT_VARIABLES[dataset] if dataset in ROOT_VARIABLES else ''}."
            )
        return DemoSource(), "Using the demo world (synthetic towns), because no data set is configured."
    root = Path(root_text).expanduser()
    if not root.exists():
        raise UserError(f"{root_from} says the data lie in {root}, but that folder does not exist.")
    kind = dataset or _guess(root, root_from)
    opened: SceneSource
    if kind == "nuscenes":
        opened = NuScenesSource(root, split_scheme=split_scheme)
    elif kind == "log":
        opened = LogSource(root) if rate is None else LogSource(root, rate)
    else:
        opened = Argoverse2Source(root, split_scheme=split_scheme, official_frames=official_frames)
    why = f"as {dataset_from} and {root_from} say" if dataset else f"recognised in the folder that {root_from} names"
    version = f" {opened.version}" if isinstance(opened, NuScenesSource) else ""
    return opened, f"Using {kind}{version} in {root}, {why}."


def _setting(argument: object, option: str, variable: str) -> tuple[str | None, str]:
    """Return the value of an option or else of the environment, and the name of the one that gave it."""
    if argument is not None:
        return str(argument), option
    return os.environ.get(variable) or None, variable


def _customary_root(dataset: str | None, dataset_from: str) -> tuple[str | None, str, str | None, str]:
    set_variables = {
        kind: variable
        for kind, variable in ROOT_VARIABLES.items()
        if os.environ.get(variable) and dataset in (None, kind)
    }
    if len(set_variables) > 1:
        raise UserError(
            f"Both {' and '.join(set_variables.values())} are set: choose with --dataset nuscenes or argoverse2."
        )
    for kind, variable in set_variables.items():
        return kind, dataset_from if dataset else variable, os.environ[variable], variable
    return dataset, dataset_from, None, ""


def _guess(root: Path, root_from: str) -> str:
    """Recognise the data set by what lies in its folder."""
    kind = _kind_of(root)
    if kind is not None:
        return kind
    raise UserError(
        f"{root_from} says the data lie in {root}, but that is neither nuScenes (no v1.0-*/scene.json) nor Argoverse 2 "
        "(no log folders with city_SE3_egovehicle.feather, directly or in train, val or test) nor logs of your own (no "
        "calibration.json, likewise; docs/own-logs.md)."
    )


def _kind_of(root: Path) -> str | None:
    if find_versions(root):
        return "nuscenes"
    if find_logs(root):
        return "argoverse2"
    return "log" if find_own_logs(root) else None


def folder_named(text: str, dataset: str | None) -> tuple[str, Path] | None:
    """Return data set and folder where a command names a folder instead of a scene; None where it names a scene.

    Args:
        text: of the command.
        dataset: if the command names one.
    """
    root = Path(text).expanduser()
    kind = (dataset or _kind_of(root)) if root.is_dir() else None
    return None if kind is None else (kind, root)


def only_scene(source: SceneSource) -> str:
    """Return the name of the only scene of a data set; UserError with the names if it has several."""
    names = [info.name for info in source.scenes()]
    if len(names) != 1:
        some = ", ".join(names[:4]) + (", ..." if len(names) > 4 else "")
        raise UserError(f"{source.root} holds {len(names)} scenes ({some}): name one of them, or map all with 'batch'.")
    return names[0]
