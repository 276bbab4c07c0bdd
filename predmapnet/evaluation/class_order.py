"""Recognition of results whose classes are numbered in another way, by the kinds of the truth on which they lie."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations
from pathlib import Path

import numpy as np

from mapfusion.arrays import Integer
from mapfusion.elements import ElementKind
from predmapnet.errors import UserError
from predmapnet.evaluation.chamfer_distance import chamfer_matrix, resample_all
from predmapnet.evaluation.frames import EvaluationFrame

REACH = 1.0
"""Metres, chamfer; nearer elements are the same, whatever their kinds."""
POINTS = 50
ENOUGH = 5
"""Elements of a kind that must lie on the truth of another one before it counts as misnamed."""
MOST = 0.7
"""Share of the elements of a kind that must do so."""


def kinds_found(frames: Sequence[EvaluationFrame]) -> Integer:
    """Count the predictions that lie on a true element, ``(3, 3)``: by their own kind, and by that of the truth."""
    counts = np.zeros((len(ElementKind), len(ElementKind)), dtype=np.int64)
    for frame in frames:
        predicted, truth = frame.predicted, frame.truth
        if len(predicted) and len(truth.kinds):
            lines, truths = resample_all(predicted.polylines, POINTS), resample_all(truth.polylines, POINTS)
            alike = np.zeros_like(predicted.kinds), np.zeros_like(truth.kinds)
            matrix = chamfer_matrix(lines, alike[0], truths, alike[1], limit=REACH)
            nearest = matrix.argmin(axis=1)
            near = matrix[np.arange(len(nearest)), nearest] <= REACH
            np.add.at(counts, (predicted.kinds[near], truth.kinds[nearest[near]]), 1)
    return counts


def check_class_order(path: Path, counts: Integer) -> None:
    """Raise UserError for :func:`kinds_found` of which two kinds or more lie on each other's truth."""
    for order in permutations(ElementKind):
        moved = [kind for kind in ElementKind if order[kind] is not kind and counts[kind].sum() >= ENOUGH]
        if len(moved) >= 2 and all(counts[kind, order[kind]] >= MOST * counts[kind].sum() for kind in moved):
            what = ", ".join(f"elements labelled {kind.label} lie on true {order[kind].nouns}" for kind in moved)
            raise UserError(
                f"{path}: the classes are numbered in another way: {what}. 0 is ped_crossing, 1 divider and 2 boundary "
                "(MapTR has divider 0 and ped_crossing 1)."
            )
