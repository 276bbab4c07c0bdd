"""Comparison of methods by their figures: means over the scenes, and what of them chance could have made.

Scenes are drawn with replacement, the same ones for all methods; the interval of a mean, and that of the difference to
the first method, holds 95 % of the draws. A difference whose interval holds 0 is one that other scenes could turn.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mapfusion.arrays import Bool, Float, Integer
from mapfusion.merge.report import short_names
from predmapnet.datasets.fields import EXACT
from predmapnet.datasets.large_tables import parse_json
from predmapnet.errors import UserError
from predmapnet.evaluation.scene_figures import SCENE_FIGURES

DRAWS = 10_000
CONFIDENCE = 0.95
FEW_SCENES = 10
"""Below this number of scenes, intervals are too narrow to be trusted."""

POOLED = {
    "chamfer_mAP": ("chamfer_ap", "mAP"),
    "ahead_mAP": ("ahead_ap", "mAP"),
    "rear_mAP": ("rear_ap", "mAP"),
    "frechet_mAP": ("frechet_ap", "mAP"),
    "raster_mAP": ("raster_ap", "mAP"),
    "consistency_mAP": ("consistency_ap", "mAP"),
    "mAS": ("stability", "mAS"),
    "map_precision@1.0": ("global_map", "precision@1.0"),
    "map_recall@1.0": ("global_map", "recall@1.0"),
    "map_f1@1.0": ("global_map", "f1@1.0"),
    "global_mAP": ("global_map_ap", "mAP"),
}
"""Section and key of the official figure over all scenes together."""
_SAME = {
    "dataset": "data set",
    "split": "split",
    "split_scheme": "split scheme",
    "official_frames": "choice of frames",
    "roi_m": "region",
}


@dataclass(frozen=True)
class Estimate:
    """Mean over scenes and its interval, which has no width if there is one scene only."""

    mean: float
    low: float
    high: float


@dataclass(frozen=True)
class MethodFigure:
    """One figure of one method.

    ``pooled`` is the official one over all scenes together (None where it does not exist), ``difference`` that to the
    first method, scene by scene (None for the first).
    """

    pooled: float | None
    scenes: Estimate
    difference: Estimate | None

    @property
    def clear(self) -> bool:
        """Whether the interval of the difference lies on one side of 0."""
        return self.difference is not None and self.difference.low * self.difference.high > 0.0


@dataclass(frozen=True)
class Comparison:
    """Methods side by side.

    Attributes:
        methods: their names; differences are to the first.
        scenes: number of scenes.
        figures: per name in SCENE_FIGURES one entry per method; figures that a method lacks are absent.
        counted: per figure the number of scenes that have it.
        notes: what a reader must know.
        seed: of the draws.
    """

    methods: tuple[str, ...]
    scenes: int
    figures: Mapping[str, tuple[MethodFigure, ...]]
    counted: Mapping[str, int]
    notes: tuple[str, ...]
    seed: int

    def content(self) -> dict[str, Any]:
        """Return everything as written to JSON."""
        return {
            "methods": list(self.methods),
            "scenes": self.scenes,
            "draws": DRAWS,
            "confidence": CONFIDENCE,
            "seed": self.seed,
            "notes": list(self.notes),
            "figures": {
                name: {
                    "scenes": self.counted[name],
                    **{method: _content(entry) for method, entry in zip(self.methods, entries, strict=True)},
                }
                for name, entries in self.figures.items()
            },
        }


def compare_evaluations(paths: Sequence[Path], seed: int = 0) -> Comparison:
    """Compare evaluations, files of ``predmapnet evaluate --json``, with the first of them; ``seed`` is of the draws.

    Raises:
        UserError: a file is missing, is no evaluation or has no figures of single scenes, or the evaluations are of
            different data, so that nothing can be concluded from them.
    """
    if len(paths) < 2:
        raise UserError("A comparison needs at least two files of 'predmapnet evaluate --json'.")
    names = [os.path.realpath(path) for path in paths]
    twice = next((path for path, name in zip(paths, names, strict=True) if names.count(name) > 1), None)
    if twice is not None:
        raise UserError(f"{twice} is given twice.")
    evaluations = [_read(path) for path in paths]
    _check_same(paths, evaluations)
    scenes = sorted(evaluations[0]["per_scene"])
    draws = np.random.default_rng(seed).integers(len(scenes), size=(DRAWS, len(scenes)))
    notes = _notes(evaluations, len(scenes))
    figures, counted = {}, {}
    for name in SCENE_FIGURES:
        values = np.array([[_value(content, scene, name) for scene in scenes] for content in evaluations])
        held = np.isfinite(values).all(axis=0)
        if not held.any() or (name == "mAS" and not _same_stability(evaluations)):
            continue
        estimates = [_estimate(row, held, draws) for row in values]
        differences = [None, *(_estimate(row - values[0], held, draws) for row in values[1:])]
        pooled = [_pooled(content, name) for content in evaluations]
        figures[name] = tuple(MethodFigure(*entry) for entry in zip(pooled, estimates, differences, strict=True))
        counted[name] = int(held.sum())
    return Comparison(tuple(short_names(list(paths))), len(scenes), figures, counted, tuple(notes), seed)


def _read(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise UserError(f"There is no file {path}.")
    content = parse_json(path.read_bytes(), path)
    if not isinstance(content, dict) or not isinstance(content.get("evaluated"), dict):
        raise UserError(f"{path} is no evaluation; make one with 'predmapnet evaluate --json {path.name}'.")
    per_scene = content.get("per_scene")
    if not isinstance(per_scene, dict) or not per_scene:
        version = content["evaluated"].get("version", "unknown")
        raise UserError(
            f"{path} has no figures of single scenes (it was written by predmapnet {version}); "
            "run 'predmapnet evaluate --json' again."
        )
    for scene, figures in per_scene.items():
        wrong = [name for name in SCENE_FIGURES if not isinstance(figures, dict) or not _is_figure(figures.get(name))]
        if wrong:
            raise UserError(f"{path}: {wrong[0]} of {scene} is no number.")
    for section, name in [*POOLED.values(), ("stability", "interval")]:
        figures = content.get(section) or {}
        if not isinstance(figures, dict) or not _is_figure(figures.get(name)):
            raise UserError(f"{path}: {name} of {section} is no number.")
    texts = [content["evaluated"].get("warnings", []), [(content.get("stability") or {}).get("protocol", "")],
             [(content.get("consistency_ap") or {}).get("ids", "")]]  # fmt: skip
    if not all(isinstance(several, list) and all(isinstance(one, str | None) for one in several) for several in texts):
        raise UserError(f"{path}: its warnings, protocol of stability and ids of consistency must be texts.")
    return content


def _is_figure(value: Any) -> bool:
    """Whether a value is a number or null; an integer that no figure reaches is neither."""
    return value is None or isinstance(value, float) or (isinstance(value, int) and abs(value) < EXACT)


def _check_same(paths: Sequence[Path], evaluations: Sequence[Mapping[str, Any]]) -> None:
    first = evaluations[0]
    for path, other in zip(paths[1:], evaluations[1:], strict=True):
        for key, text in _SAME.items():
            one, two = first["evaluated"].get(key), other["evaluated"].get(key)
            if one != two:
                raise UserError(
                    f"{paths[0]} and {path} differ in the {text} ({one} and {two}); they say nothing of each other."
                )
        lacking = sorted(set(first["per_scene"]) ^ set(other["per_scene"]))
        if lacking:
            held = paths[0] if lacking[0] in first["per_scene"] else path
            raise UserError(
                f"{paths[0]} and {path} are not of the same scenes: {lacking[0]}"
                f"{f' and {len(lacking) - 1} more' if len(lacking) > 1 else ''} only in {held}."
            )
        for scene, figures in first["per_scene"].items():
            if figures.get("frames") != other["per_scene"][scene].get("frames"):
                raise UserError(f"{paths[0]} and {path} have different numbers of frames in {scene}.")


def _notes(evaluations: Sequence[Mapping[str, Any]], scenes: int) -> list[str]:
    few = "1 scene" if scenes == 1 else f"{scenes} scenes"
    notes = [] if scenes >= FEW_SCENES else [f"{few} only: the intervals are narrower than the truth"]
    if not _same_stability(evaluations):
        notes.append("the stability was measured by different protocols and is left out")
    if len({(content.get("consistency_ap") or {}).get("ids") for content in evaluations}) > 1:
        notes.append("consistency: some methods have track ids of their own, for others they were formed afterwards")
    shared: dict[str, None] = {}
    for content in evaluations:
        shared |= dict.fromkeys(content["evaluated"].get("warnings", []))
    return [*notes, *shared]


def _same_stability(evaluations: Sequence[Mapping[str, Any]]) -> bool:
    settings = [content.get("stability") or {} for content in evaluations]
    return len({(each.get("protocol"), each.get("interval")) for each in settings}) == 1


def _value(content: Mapping[str, Any], scene: str, name: str) -> float:
    value = content["per_scene"][scene].get(name)
    return np.nan if value is None else float(value)


def _pooled(content: Mapping[str, Any], name: str) -> float | None:
    section, key = POOLED[name]
    value = (content.get(section) or {}).get(key)
    return None if value is None else float(value)


def _estimate(values: Float, held: Bool, draws: Integer) -> Estimate:
    """Mean of the scenes that have a figure, and its interval; a draw without any of them is left out."""
    filled = np.where(held, values, 0.0)
    counts = held[draws].sum(axis=1)
    means = filled[draws].sum(axis=1)[counts > 0] / counts[counts > 0]
    low, high = np.quantile(means, [(1.0 - CONFIDENCE) / 2, (1.0 + CONFIDENCE) / 2])
    return Estimate(float(values[held].mean()), float(low), float(high))


def _content(entry: MethodFigure) -> dict[str, Any]:
    content: dict[str, Any] = {
        "pooled": entry.pooled,
        "mean": entry.scenes.mean,
        "interval": [entry.scenes.low, entry.scenes.high],
    }
    if entry.difference is not None:
        content["difference"] = entry.difference.mean
        content["difference_interval"] = [entry.difference.low, entry.difference.high]
        content["clear"] = entry.clear
    return content
