"""Doubtful stretches of maps: low evidence, wide bands, and what some drives saw where others looked and did not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import shapely

from mapfusion.arrays import Bool, Float, Integer
from mapfusion.elements import GlobalMap
from mapfusion.geometry import arc_length
from mapfusion.ground import inside

SPACING = 2.0
"""Distance between samples along a line, and side of the cells in which drives are compared, metres."""

LOW_CONFIDENCE = 0.8
FEW_FRAMES = 3
"""Elements below this confidence, or seen in no more frames, have low evidence."""

WIDE = 0.4
"""Standard deviation across the line above which a stretch is wide, metres."""

LACKING = 0.5
"""Share of the drives that looked and have nothing there, from which on drives disagree."""

LONGEST = 40.0
"""Length beyond which a stretch is not more important, metres."""


@dataclass(frozen=True)
class Doubt:
    """Doubtful stretch of an element.

    Attributes:
        map, element: which; numbers of the map and of the element in it.
        line: ``(n, 2)``, metres, along it.
        length: metres.
        score: for the order; larger is more doubtful.
        reasons: for people.
    """

    map: int
    element: int
    line: Float
    length: float
    score: float
    reasons: tuple[str, ...]


@dataclass(frozen=True)
class _Samples:
    """Points along all lines of all maps, as arrays of equal length."""

    points: Float
    kinds: Integer
    maps: Integer
    elements: Integer
    evidence: Float
    frames: Integer
    deviation: Float


def doubtful_stretches(maps: Sequence[GlobalMap], grounds: Sequence[shapely.Geometry]) -> list[Doubt]:
    """Return the doubtful stretches of maps of one place, the worst first.

    Args:
        maps: metres, one frame.
        grounds: ground that each of them looked at, metres.
    """
    samples = _sampled(maps)
    if not len(samples.points):
        return []
    lookers, lacking = _looked_and_lacking(samples, grounds)
    low = np.clip((LOW_CONFIDENCE - samples.evidence) / LOW_CONFIDENCE, 0.0, 1.0) + 0.4 * (samples.frames <= FEW_FRAMES)
    wide = np.clip((samples.deviation - WIDE) / WIDE, 0.0, 1.0) + 0.2 * (samples.deviation > WIDE)
    share = lacking / np.maximum(lookers, 1)
    apart = np.where(share >= LACKING, share, 0.0)
    severity = low + wide + apart
    doubts = []
    for first, stop in _runs(severity > 0.0, samples.maps, samples.elements):
        rows = slice(first, stop)
        length = SPACING * (stop - first)
        reasons = []
        if low[rows].any():
            least, frames = samples.evidence[rows].min(), samples.frames[first]
            reasons.append(f"confidence {least:.2f}, seen in {frames} frame{'s' if frames != 1 else ''}")
        if wide[rows].any():
            reasons.append(f"± {samples.deviation[rows].max():.2f} m")
        if apart[rows].any():
            worst = first + int(np.argmax(apart[rows]))
            reasons.append(f"{lacking[worst]:.0f} of {lookers[worst]:.0f} drives do not have it")
        score = float(severity[rows].mean() * min(length, LONGEST))
        line = samples.points[rows]
        if len(line) > 2:
            line = shapely.get_coordinates(shapely.simplify(shapely.LineString(line), 0.5))
        doubts.append(
            Doubt(int(samples.maps[first]), int(samples.elements[first]), line, length, score, tuple(reasons))
        )
    return sorted(doubts, key=lambda doubt: -doubt.score)


def _sampled(maps: Sequence[GlobalMap]) -> _Samples:
    points, deviations = [np.zeros((0, 2))], [np.zeros(0)]
    counts, facts = [], []
    for number, global_map in enumerate(maps):
        for place, element in enumerate(global_map):
            along = arc_length(element.points)
            stations = np.arange(SPACING / 2, max(along[-1], SPACING), SPACING)
            points.append(np.stack([np.interp(stations, along, element.points[:, axis]) for axis in (0, 1)], axis=1))
            known = element.deviation is not None
            deviations.append(
                np.interp(stations, along, element.deviation) if known else np.zeros(len(stations))  # type: ignore[arg-type]
            )
            counts.append(len(stations))
            facts.append((int(element.kind), number, place, element.confidence, element.observations))
    table = np.repeat(np.array(facts, dtype=np.float64).reshape(-1, 5), counts, axis=0)
    kinds, numbers, places, evidence, frames = table.T
    return _Samples(
        np.concatenate(points),
        kinds.astype(np.int64),
        numbers.astype(np.int64),
        places.astype(np.int64),
        evidence,
        frames.astype(np.int64),
        np.concatenate(deviations),
    )


def _looked_and_lacking(samples: _Samples, grounds: Sequence[shapely.Geometry]) -> tuple[Float, Float]:
    """Return for each sample how many maps looked there, and how many of those have nothing of its kind near."""
    count = len(samples.points)
    if len(grounds) < 2:
        return np.ones(count), np.zeros(count)
    cells = np.floor(samples.points / SPACING).astype(np.int64)
    cells -= cells.min(axis=0) - 1
    width = int(cells[:, 0].max()) + 2
    place = (cells[:, 1] * width + cells[:, 0]) * 3 + samples.kinds
    spots, spot_of = np.unique(place, return_inverse=True)
    middles = np.zeros((len(spots), 2))
    middles[spot_of] = samples.points
    having = np.unique(place * len(grounds) + samples.maps)
    owners, have_places = having % len(grounds), having // len(grounds)
    looked, lacked = np.zeros(len(spots)), np.zeros(len(spots))
    steps = [3 * (row * width + column) for row in (-1, 0, 1) for column in (-1, 0, 1)]
    for number, ground in enumerate(grounds):
        if ground.is_empty:
            continue
        low, high = np.array(ground.bounds).reshape(2, 2)
        near = np.flatnonzero(((middles >= low) & (middles <= high)).all(axis=1))
        near = near[inside(ground, middles[near])]
        own = have_places[owners == number]
        own_or_beside = np.unique(np.concatenate([own + step for step in steps]))
        looked[near] += 1
        lacked[near] += ~np.isin(spots[near], own_or_beside, assume_unique=True)
    return looked[spot_of], lacked[spot_of]


def _runs(flags: Bool, maps: Integer, elements: Integer) -> list[tuple[int, int]]:
    """Return first row and past the last of each run of flagged samples of one element."""
    begins = np.ones(len(flags), dtype=bool)
    begins[1:] = (flags[1:] != flags[:-1]) | (maps[1:] != maps[:-1]) | (elements[1:] != elements[:-1])
    starts = np.append(np.flatnonzero(begins), len(flags))
    return [(int(first), int(stop)) for first, stop in pairwise(starts) if flags[first]]
