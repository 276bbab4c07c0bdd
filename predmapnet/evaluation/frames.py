"""Input of the per-frame metrics: predictions and ground truth, checked once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from mapfusion.arrays import Float, Integer
from mapfusion.elements import ElementKind, FrameMap
from predmapnet.errors import UserError
from predmapnet.scenes import FrameTruth

SIMPLIFICATION = 0.2
"""Tolerance of the ground truth in the official evaluation, metres."""


@dataclass(frozen=True)
class EvaluationFrame:
    """Prediction and ground truth of one instant.

    Attributes:
        scene: name of the scene.
        index: position in the scene, from 0; the frames of a scene are consecutive.
        predicted: in the ego frame.
        truth: ground truth of the same ROI, in the ego frame, not simplified.

    Raises:
        UserError: a polyline is empty or not finite, a forecast is not finite, a score is not from 0 to 1, or a kind
            does not exist; the message names the scene, the frame and the element.
    """

    scene: str
    index: int
    predicted: FrameMap
    truth: FrameTruth

    def __post_init__(self) -> None:
        where = f"Scene {self.scene}, frame {self.index}"
        _check_elements(f"{where}, prediction", self.predicted.kinds, self.predicted.polylines)
        _check_elements(f"{where}, ground truth", self.truth.kinds, self.truth.polylines)
        for row, points in enumerate(self.predicted.forecasts or ()):
            if not np.isfinite(points).all():
                raise UserError(f"{where}, forecast {row}: the polyline holds NaN or infinite coordinates.")
        bad = np.flatnonzero(~((self.predicted.scores >= 0.0) & (self.predicted.scores <= 1.0)))
        if len(bad):
            score = self.predicted.scores[bad[0]]
            raise UserError(f"{where}, prediction {bad[0]}: the score is {score}, not a number from 0 to 1.")

    @property
    def name(self) -> str:
        """Scene and index, as messages and reports call the frame."""
        return f"{self.scene}/{self.index}"


def _check_elements(where: str, kinds: Integer, polylines: Sequence[Float]) -> None:
    for row, points in enumerate(polylines):
        if points.ndim != 2 or points.shape[1] != 2 or len(points) == 0:
            raise UserError(f"{where} {row}: a polyline must be (n, 2) with n >= 1, this one is {points.shape}.")
    if len(polylines) and not np.isfinite(np.concatenate(polylines)).all():
        row = next(row for row, points in enumerate(polylines) if not np.isfinite(points).all())
        raise UserError(f"{where} {row}: the polyline holds NaN or infinite coordinates.")
    unknown = np.flatnonzero(~np.isin(kinds, list(ElementKind)))
    if len(unknown):
        raise UserError(f"{where} {unknown[0]}: there is no element kind {kinds[unknown[0]]} (0, 1 and 2 exist).")


def simplify_all(polylines: Sequence[Float]) -> tuple[Float, ...]:
    """Simplify lines ``(k, 2)`` by 0.2 m with topology kept, as the official evaluation does with its ground truth.

    Lines of one point stay as they are.
    """
    drawable = [row for row, points in enumerate(polylines) if len(points) >= 2]
    result = list(polylines)
    if drawable:
        counts = [len(polylines[row]) for row in drawable]
        coordinates = np.concatenate([polylines[row] for row in drawable])
        lines = shapely.linestrings(coordinates, indices=np.repeat(np.arange(len(drawable)), counts))
        shorter = shapely.simplify(lines, SIMPLIFICATION, preserve_topology=True)
        vertices, owner = shapely.get_coordinates(shorter, return_index=True)
        parts = np.split(vertices, np.searchsorted(owner, np.arange(1, len(drawable))))
        for row, points in zip(drawable, parts, strict=True):
            result[row] = points
    return tuple(result)
