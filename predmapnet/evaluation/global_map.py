"""Quality of the map of a whole drive: length-weighted precision and recall, whole elements, lateral error.

Both maps are cut into samples every 0.25 m, each of which stands for its share of the line. A predicted sample is
right if a true line of its kind runs within the threshold (exact distance to the line); a true sample is found if a
predicted line does. Crossings count as their outlines. Truth that the car never came near is left out: recall and
whole elements are counted inside the union of the regions of interest along the drive.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import shapely

from mapfusion.arrays import Float, Integer
from mapfusion.elements import ElementKind, GlobalMap, RegionOfInterest
from mapfusion.geometry import chamfer_distance, transform_points
from predmapnet.errors import UserError
from predmapnet.evaluation.chamfer_distance import match_greedily
from predmapnet.evaluation.precision_recall import AveragePrecision, Matches, accumulate

THRESHOLDS = (0.5, 1.0, 1.5)
"""Metres."""
SAMPLE_SPACING = 0.25
"""Metres."""
ELEMENT_THRESHOLD = 1.0
"""Metres; how near a predicted element must run to a true one to be one of its fragments."""
SHORTEST_PART = 1.0
"""Metres; shorter stretches of a true line inside the seen area do not count as elements."""


@dataclass(frozen=True)
class KindQuality:
    """Counts of one kind (or of all), in one scene or pooled over several.

    Attributes:
        right: ``(t,)`` predicted metres within each threshold of a true line.
        found: ``(t,)`` true metres within each threshold of a predicted line.
        predicted, true: metres in all.
        lateral_errors: ``(n,)`` metres, distance of each predicted sample to the nearest true line of its kind,
            samples beyond the largest threshold left out.
        fragments: predicted elements that follow a true element.
        followed: true elements that at least one predicted element follows.
        duplicates: fragments that mostly repeat stretches which a more confident fragment covers.
        predicted_elements, true_elements: numbers of elements.
    """

    right: Float
    found: Float
    predicted: float
    true: float
    lateral_errors: Float
    fragments: int
    followed: int
    duplicates: int
    predicted_elements: int
    true_elements: int

    @property
    def precision(self) -> Float:
        """``(t,)``; NaN if nothing was predicted."""
        return _ratio(self.right, self.predicted)

    @property
    def recall(self) -> Float:
        """``(t,)``; NaN if there is nothing to find."""
        return _ratio(self.found, self.true)

    @property
    def f1(self) -> Float:
        """``(t,)`` harmonic mean; 0 if only one of the two maps is empty, NaN if both are."""
        if self.predicted == 0.0 and self.true == 0.0:
            return np.full(len(self.right), np.nan)
        precision, recall = np.nan_to_num(self.precision), np.nan_to_num(self.recall)
        both = precision + recall
        return np.divide(2 * precision * recall, both, out=np.zeros_like(both), where=both > 0)

    def figures(self) -> dict[str, object]:
        """As written to JSON; a figure that does not exist is None."""
        figures: dict[str, object] = {}
        for name, values in (("precision", self.precision), ("recall", self.recall), ("f1", self.f1)):
            figures |= {f"{name}@{at}": _number(value) for at, value in zip(THRESHOLDS, values, strict=True)}
        median, high = np.percentile(self.lateral_errors, [50, 95]) if len(self.lateral_errors) else (np.nan, np.nan)
        return figures | {
            "lateral_median_m": _number(median),
            "lateral_p95_m": _number(high),
            "fragmentation": _number(self.fragments / self.followed if self.followed else np.nan),
            "duplicates": self.duplicates,
            "predicted_elements": self.predicted_elements,
            "true_elements": self.true_elements,
            "predicted_m": self.predicted,
            "true_m": self.true,
        }


@dataclass(frozen=True)
class GlobalMapQuality:
    """Quality of one global map, or of several pooled.

    Attributes:
        kinds: one entry per :class:`mapfusion.ElementKind`.
        elements: average precision of whole elements by chamfer distance, confidence as the score.
        matches: from which it comes, for pooling.
    """

    kinds: tuple[KindQuality, ...]
    elements: AveragePrecision
    matches: Matches

    @property
    def overall(self) -> KindQuality:
        """All kinds together, each metre counting the same."""
        return _sum(self.kinds)

    def figures(self) -> dict[str, object]:
        """Nested figures as written to JSON: overall ones, then per kind; ``element_mAP`` for whole elements."""
        figures = self.overall.figures()
        figures["element_mAP"] = self.elements.mean
        for kind in ElementKind:
            curves = self.elements.kinds[kind]
            entry = self.kinds[kind].figures() | {"element_AP": curves.average_precision}
            entry |= {f"element_AP@{curve.threshold}": curve.average_precision for curve in curves.curves}
            figures[kind.label] = entry
        return figures


def seen_area(ego_to_global: Sequence[Float], roi: RegionOfInterest) -> shapely.Geometry:
    """Return the union of the regions of interest along a drive of ``(4, 4)`` poses, global frame, metres."""
    corners = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * roi.size / 2
    rectangles = [shapely.Polygon(transform_points(pose, corners)) for pose in ego_to_global]
    return shapely.union_all(rectangles)


def global_map_quality(
    predicted: GlobalMap, truth: GlobalMap, seen: shapely.Geometry | None = None
) -> GlobalMapQuality:
    """Measure a global map against the true one in the same frame, not clipped; confidences are the scores.

    Truth counts inside ``seen`` (see :func:`seen_area`); everywhere if that is None.

    Raises:
        UserError: an element holds NaN or infinite coordinates; the message names it.
    """
    _check_finite("predicted", predicted)
    _check_finite("true", truth)
    results, matches = [], []
    for kind in ElementKind:
        # A line without two points has no length and cannot be right, but it still counts as an element.
        elements = predicted.of_kind(kind)
        lines = [element.points for element in elements]
        confidence = np.array([element.confidence for element in elements], dtype=np.float64)
        unclipped = [element.points for element in truth.of_kind(kind)]
        clipped = _clip(unclipped, kind, seen)
        results.append(_kind_quality(lines, confidence, unclipped, clipped, seen))
        matched = match_greedily(_chamfer(lines, clipped), confidence, THRESHOLDS)
        kinds, true_kinds = (np.full(len(some), int(kind), dtype=np.int64) for some in (lines, clipped))
        matches.append(Matches.of(kinds, confidence, matched, true_kinds))
    return _quality(results, matches)


def pool(qualities: Sequence[GlobalMapQuality]) -> GlobalMapQuality:
    """Pool the maps of several scenes: lengths and counts add up, elements are ranked together."""
    kinds = [_sum([quality.kinds[kind] for quality in qualities]) for kind in ElementKind]
    return _quality(kinds, [quality.matches for quality in qualities])


def _quality(kinds: Sequence[KindQuality], matches: Sequence[Matches]) -> GlobalMapQuality:
    return GlobalMapQuality(tuple(kinds), accumulate(matches, THRESHOLDS), Matches.together(matches, len(THRESHOLDS)))


def _kind_quality(
    lines: list[Float], confidence: Float, unclipped: list[Float], clipped: list[Float], seen: shapely.Geometry | None
) -> KindQuality:
    predicted_samples, predicted_weight, predicted_owner = _sample(lines)
    true_samples, true_weight, _ = _sample(unclipped)
    if seen is not None and len(true_samples):
        shapely.prepare(seen)
        inside = shapely.contains_xy(seen, true_samples)
        true_samples, true_weight = true_samples[inside], true_weight[inside]
    # What is predicted outside the seen area is right or wrong by the unclipped truth.
    error, _ = _nearest(predicted_samples, unclipped)
    miss, _ = _nearest(true_samples, lines)
    fragments, followed, duplicates = _follow(predicted_samples, predicted_owner, confidence, clipped)
    return KindQuality(
        right=np.array([predicted_weight[error <= threshold].sum() for threshold in THRESHOLDS]),
        found=np.array([true_weight[miss <= threshold].sum() for threshold in THRESHOLDS]),
        predicted=float(predicted_weight.sum()),
        true=float(true_weight.sum()),
        lateral_errors=error[error <= THRESHOLDS[-1]],
        fragments=fragments,
        followed=followed,
        duplicates=duplicates,
        predicted_elements=len(lines),
        true_elements=len(clipped),
    )


def _sample(lines: Sequence[Float]) -> tuple[Float, Float, Integer]:
    """Cut lines into equal pieces of about 0.25 m: centres ``(n, 2)``, lengths ``(n,)`` and lines ``(n,)``."""
    samples, weights, owners = [np.zeros((0, 2))], [np.zeros(0)], [np.zeros(0, dtype=np.int64)]
    for row, points in enumerate(lines):
        distance = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        length = distance[-1]
        if length == 0.0:
            continue
        pieces = max(1, round(length / SAMPLE_SPACING))
        centres = (np.arange(pieces) + 0.5) * (length / pieces)
        samples.append(np.stack([np.interp(centres, distance, points[:, axis]) for axis in range(2)], axis=1))
        weights.append(np.full(pieces, length / pieces))
        owners.append(np.full(pieces, row))
    return np.concatenate(samples), np.concatenate(weights), np.concatenate(owners)


def _nearest(samples: Float, lines: Sequence[Float]) -> tuple[Float, Integer]:
    """Distance of each sample to the nearest line and that line's row; infinite and -1 beyond the last threshold."""
    distance = np.full(len(samples), np.inf)
    owner = np.full(len(samples), -1, dtype=np.int64)
    usable = [row for row, points in enumerate(lines) if len(points) >= 2]
    if not usable or not len(samples):
        return distance, owner
    segments = np.concatenate([np.stack([lines[row][:-1], lines[row][1:]], axis=1) for row in usable])
    owners = np.repeat(usable, [len(lines[row]) - 1 for row in usable])
    tree = shapely.STRtree(shapely.linestrings(segments))
    (rows, hits), distances = tree.query_nearest(
        shapely.points(samples), max_distance=THRESHOLDS[-1] + 1e-9, return_distance=True, all_matches=False
    )
    distance[rows], owner[rows] = distances, owners[hits]
    return distance, owner


def _follow(samples: Float, owner: Integer, confidence: Float, truths: list[Float]) -> tuple[int, int, int]:
    """Count fragments, followed true elements and duplicates.

    A predicted element follows the true element that runs nearest to most of it, if at least half of it lies
    within 1 m of that one. It is a duplicate if more confident fragments of the same true element already cover
    at least half of the stretches (1 m long) that it covers.
    """
    distance, nearest = _nearest(samples, truths)
    near = distance <= ELEMENT_THRESHOLD
    covered: dict[int, set[int]] = {}
    fragments = duplicates = 0
    for row in np.argsort(-confidence, kind="stable"):
        own = owner == row
        if not (own & near).any():
            continue
        votes = np.bincount(nearest[own & near])
        best = int(votes.argmax())
        if 2 * votes[best] < own.sum():
            continue
        fragments += 1
        line = shapely.LineString(truths[best])
        along = shapely.line_locate_point(line, shapely.points(samples[own & near & (nearest == best)]))
        stretches = set(np.floor(along).astype(int).tolist())
        already = covered.setdefault(best, set())
        duplicates += 2 * len(stretches & already) >= len(stretches)
        already |= stretches
    return fragments, len(covered), int(duplicates)


def _chamfer(lines: list[Float], truths: list[Float]) -> Float:
    """Chamfer distances ``(n, m)`` between whole elements, sampled every 0.25 m; infinite where certainly too far."""
    matrix = np.full((len(lines), len(truths)), np.inf)
    if not lines or not truths:
        return matrix
    reach = THRESHOLDS[-1] + 1e-6
    lows, highs = np.array([points.min(axis=0) for points in lines]), np.array([points.max(axis=0) for points in lines])
    predicted = [_with_ends(points) for points in lines]
    for column, truth in enumerate(truths):
        gaps = np.maximum(np.maximum(lows - truth.max(axis=0), truth.min(axis=0) - highs), 0.0)
        for row in np.flatnonzero(np.hypot(gaps[:, 0], gaps[:, 1]) <= reach):
            matrix[row, column] = chamfer_distance(predicted[row], _with_ends(truth))
    return matrix


def _with_ends(points: Float) -> Float:
    samples = _sample([points])[0]
    return np.concatenate([points[:1], samples, points[-1:]])


def _clip(lines: list[Float], kind: ElementKind, seen: shapely.Geometry | None) -> list[Float]:
    """Cut true elements at the border of the seen area; a cut crossing becomes the outline of what is left."""
    usable = [points for points in lines if len(points) >= 2]
    if seen is None:
        return usable
    if kind.is_ring:
        whole = shapely.make_valid([shapely.Polygon(points) for points in usable if len(points) >= 4])
        polygons = shapely.get_parts(shapely.intersection(whole, seen))
        inside = [shapely.get_exterior_ring(part) for part in polygons if part.geom_type == "Polygon"]
    else:
        parts = shapely.intersection([shapely.LineString(points) for points in usable], seen)
        inside = [part for part in shapely.get_parts(parts) if part.geom_type == "LineString"]
    return [shapely.get_coordinates(part) for part in inside if shapely.length(part) >= SHORTEST_PART]


def _check_finite(which: str, vector_map: GlobalMap) -> None:
    for row, element in enumerate(vector_map):
        if not np.isfinite(element.points).all():
            raise UserError(
                f"The {which} map's element {row} ({element.kind.label}) holds NaN or infinite coordinates."
            )


def _sum(qualities: Iterable[KindQuality]) -> KindQuality:
    parts = list(qualities)
    names = [each.name for each in fields(KindQuality) if each.name != "lateral_errors"]
    totals: dict[str, Any] = {name: sum(getattr(part, name) for part in parts) for name in names}
    return KindQuality(**totals, lateral_errors=np.concatenate([part.lateral_errors for part in parts]))


def _ratio(part: Float, whole: float) -> Float:
    return part / whole if whole > 0 else np.full(len(part), np.nan)


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
