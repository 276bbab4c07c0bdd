"""Figures of single scenes: one number per metric, which a bootstrap over scenes can draw from."""

from __future__ import annotations

import numpy as np

from mapfusion.elements import ElementKind
from predmapnet.evaluation.measurement import SceneMeasurement, pool_scenes
from predmapnet.evaluation.precision_recall import AveragePrecision

SCENE_FIGURES = {
    "chamfer_mAP": "chamfer mAP",
    "ahead_mAP": "chamfer mAP ahead",
    "rear_mAP": "chamfer mAP rear",
    "frechet_mAP": "Frechet mAP",
    "raster_mAP": "rasterisation mAP",
    "consistency_mAP": "consistency mAP",
    "mAS": "stability mAS",
    "map_precision@1.0": "map precision @1.0 m",
    "map_recall@1.0": "map recall @1.0 m",
    "map_f1@1.0": "map F1 @1.0 m",
    "global_mAP": "global mAP",
}
"""Figures of a scene by name, and what they are called in tables."""


def scene_figures(scene: SceneMeasurement) -> dict[str, float | int | None]:
    """Return the figures of one scene as if it were the whole data set, by the names in SCENE_FIGURES.

    Unlike the official means over a data set, a kind that the scene does not hold is left out instead of counting as 0,
    so that scenes can be compared. A figure that does not exist is None.
    """
    alone = pool_scenes([scene])
    consistency = alone.consistency if alone.has_tracks else alone.formed_consistency
    whole = None if alone.global_map is None else alone.global_map.overall.figures()
    steady = alone.stability
    held = [kind for kind in ElementKind if (steady.counted & (steady.kinds == kind)).any()]
    return {
        "frames": len(scene.frames),
        "chamfer_mAP": _mean(alone.chamfer),
        "ahead_mAP": _mean(alone.ahead),
        "rear_mAP": _mean(alone.rear),
        "frechet_mAP": _mean(alone.frechet),
        "raster_mAP": alone.raster.mean,
        "consistency_mAP": _mean(consistency),
        "mAS": float(np.mean([steady.mean_of("stability", kind) for kind in held])) if held else None,
        "map_precision@1.0": None if whole is None else _number(whole["precision@1.0"]),
        "map_recall@1.0": None if whole is None else _number(whole["recall@1.0"]),
        "map_f1@1.0": None if whole is None else _number(whole["f1@1.0"]),
        "global_mAP": None if alone.global_map_ap is None else _mean(alone.global_map_ap),
    }


def _mean(result: AveragePrecision) -> float | None:
    present = [kind.average_precision for kind in result.kinds if kind.truths]
    return float(np.mean(present)) if present else None


def _number(value: object) -> float | None:
    return value if isinstance(value, float) else None
