"""Uncertainty of fused elements: which part of the detector's errors averages out, and which does not.

The error of a detection across the line is the sum of parts that differ in how long they last: one that is new in
every frame, some that stay while the car moves on by a certain distance, one that stays as long as the track does, and
one that no observation shows (:attr:`mapfusion.IntegratorConfig.common_deviation`). Only what is new averages out. How
much each of the others has is learnt from the differences between two detections of the same station, by the distance
that the car went between them and by whether the track was the same (a variogram), for the whole map; how noisy a
stretch of one element is, from the scatter of its own observations. Both start from a prior that stands for few
observations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import nnls
from scipy.special import expit

from mapfusion.arrays import Float, Integer, Marks, Rows
from mapfusion.integrate.fused_ring import FusedRing
from mapfusion.integrate.marks import PLACE, distinct
from mapfusion.integrate.station_curve import INFORMATION, OBSERVATIONS, PLACES, SCATTER, TRACKS, StationCurve

LASTING = np.array([10.0, 30.0])
"""Correlation lengths of the parts between frame and track: how far the car goes until they change, metres."""

PRIOR_SHARES = np.array([0.5, 0.15, 0.2, 0.15])
"""Prior shares in the variance of a detection: new in every frame, :data:`LASTING`, track."""

PRIOR_SPREAD = 0.6
"""Standard deviation of the prior of each share."""

NOTHING_LASTS = 0.1
"""Prior probability that all of the error is new in every frame."""

PRIOR_OBSERVATIONS = 6.0
"""Number of observations that the prior of an element's noise stands for."""

WINDOW = 20
"""Number of stations over which the scatter of an element is averaged: as far as errors of one detection correlate."""

RING_ROUNDING = 0.095
"""Deviation by which cells and cut-off of the signed distances round the corners of crossings, metres."""

PROBE_SPACING = 8
"""Spacing of the stations at which differences are taken, stations."""

CAPACITY = 4096
"""Number of kept passages at which they are compared and forgotten."""

COMPANIONS = (1, 2, 3, 5, 8, 13)
"""Each passage is compared with those of its station that come so many places later."""

LARGEST_SQUARE = 9.0 / 0.455
"""Largest squared difference in medians: three deviations of a normal distribution."""

LEAST_VARIANCE = 1e-3
"""Smallest variance of a detector, as a multiple of the assumed one."""

LAGS = np.array([0.0, 2.5, 7.5, 15.0, 30.0, 60.0, np.inf])
"""Classes of the distance that the car went between two observations, metres."""


class Probe(NamedTuple):
    """Passage of one detection at some stations of an element.

    Attributes:
        element: id of the element.
        stations: ``(n,) int64``, numbers of the stations.
        feet: ``(n, 2) float64``, metres, where the detection passed each of them.
        directions: ``(n, 2) float64``, unit, along the detection there.
        information: ``(n,) float64``, of the detection, 1 / m².
        car: ``(2,) float64``, metres, where it was seen from.
        track: number of its track, different for different tracks of all logs.
    """

    element: int
    stations: Integer
    feet: Float
    directions: Float
    information: Float
    car: Float
    track: int


class _Passages(NamedTuple):
    """Passages of detections at stations, one row each, sorted by element and station; columns as in :class:`Probe`."""

    element: Integer
    station: Integer
    foot: Float
    direction: Float
    information: Float
    car: Float
    track: Integer

    @classmethod
    def of(cls, probes: Sequence[Probe]) -> _Passages:
        element, stations, feet, directions, information, car, track = zip(*probes, strict=True)
        counts = [len(numbers) for numbers in stations]
        passages = cls(
            np.repeat(element, counts),
            np.concatenate(stations),
            np.concatenate(feet),
            np.concatenate(directions),
            np.concatenate(information),
            np.repeat(np.array(car), counts, axis=0),
            np.repeat(track, counts),
        )
        return passages.rows(np.lexsort((passages.station, passages.element)))

    def rows(self, rows: Rows) -> _Passages:
        return _Passages._make(column[rows] for column in self)


class _Differences(NamedTuple):
    """Differences between two detections of one station, one row each.

    Attributes:
        other_track: 1 where they belong to two tracks, else 0.
        lag: distance between the places that they were seen from, metres.
        square: squared difference across the line, as a multiple of its assumed variance.
        shared: ``(n, 3)``, what differences that hang together have in common: the element, and for one track the
            cell, a lag wide, that the car was in, for two tracks both of them.
    """

    other_track: Integer
    lag: Float
    square: Float
    shared: Integer

    @classmethod
    def between(cls, one: _Passages, two: _Passages) -> _Differences:
        gap = one.foot - two.foot
        across = gap[:, 0] * one.direction[:, 1] - gap[:, 1] * one.direction[:, 0]
        square = across**2 / (1.0 / one.information + 1.0 / two.information)
        lag = np.hypot(one.car[:, 0] - two.car[:, 0], one.car[:, 1] - two.car[:, 1])
        other = one.track != two.track
        cell = np.floor(one.car / np.maximum(lag, PLACE)[:, None]).astype(np.int64)
        tracks = np.sort(np.column_stack([one.track, two.track]), axis=1)
        shared = np.column_stack([one.element, np.where(other[:, None], tracks, cell)])
        return cls(other.astype(np.int64), lag, square, shared)


def _first_of_equal(keys: Integer) -> Rows:
    """Return one row of each set of equal rows of ``(n, columns)``, at least one row."""
    order = np.lexsort(keys.T)  # several times faster than np.unique by rows
    new = np.diff(keys[order], axis=0).any(axis=1)
    return np.asarray(order[np.append(True, new)])


@dataclass
class ErrorModel:
    """Model of a detection's error: the variances of its parts, as multiples of the assumed variance.

    Attributes:
        squares: ``(2, classes) float64``, sum of the squared differences by same or other track and by lag.
        lags: the same shape, sum of the lags, metres.
        pairs: the same shape, number of differences.
        contrasts: the same shape, about how many of the differences are independent.
    """

    squares: Float = field(default_factory=lambda: np.zeros((2, len(LAGS) - 1)))
    lags: Float = field(default_factory=lambda: np.zeros((2, len(LAGS) - 1)))
    pairs: Float = field(default_factory=lambda: np.zeros((2, len(LAGS) - 1)))
    contrasts: Float = field(default_factory=lambda: np.zeros((2, len(LAGS) - 1)))
    _probes: list[Probe] = field(default_factory=list)
    _count: int = 0

    def note(self, probe: Probe) -> None:
        """Keep where one detection passed stations of an element, to compare it with others of the same stations."""
        self._probes.append(probe)
        self._count += len(probe.stations)
        if self._count >= CAPACITY:
            self.learn()

    def learn(self) -> None:
        """Take the differences between the probes kept so far, and forget them."""
        if not self._probes:
            return
        passages = _Passages.of(self._probes)
        self._probes, self._count = [], 0
        element, station = passages.element, passages.station
        differences: list[_Differences] = []
        for step in COMPANIONS:
            same = np.flatnonzero((element[:-step] == element[step:]) & (station[:-step] == station[step:]))
            if not len(same):
                break
            differences.append(_Differences.between(passages.rows(same), passages.rows(same + step)))
        if differences:
            self._count_in(_Differences._make(map(np.concatenate, zip(*differences, strict=True))))

    def _count_in(self, differences: _Differences) -> None:
        other_track, lag, square, shared = differences
        # two lines taken for one, or a ghost beside a line, say nothing of the detector's error
        square = np.minimum(square, LARGEST_SQUARE * np.median(square))
        group = other_track * (len(LAGS) - 1) + np.searchsorted(LAGS, lag, side="right") - 1
        shape = self.pairs.shape
        for total, values in ((self.squares, square), (self.lags, lag), (self.pairs, np.ones_like(lag))):
            total += np.bincount(group, weights=values, minlength=total.size).reshape(shape)
        independent = group[_first_of_equal(np.column_stack([group, shared]))]
        self.contrasts += np.bincount(independent, minlength=self.contrasts.size).reshape(shape)

    def state(self) -> Float:
        """Return what was learnt, as one array for :meth:`from_state`; the records kept are taken in first."""
        self.learn()
        return np.stack([self.squares, self.lags, self.pairs, self.contrasts])

    @classmethod
    def from_state(cls, state: Float) -> ErrorModel:
        """Return the model of :meth:`state`."""
        squares, lags, pairs, contrasts = state.reshape(4, 2, -1).copy()
        return cls(squares, lags, pairs, contrasts)

    def parts(self) -> Float:
        """Return the variance of each part, ``(2 + len(LASTING),)``: new in every frame, lasting, track."""
        self.learn()
        row, column = np.nonzero(self.pairs)
        if not len(row):
            return PRIOR_SHARES
        pairs, contrasts = self.pairs[row, column], self.contrasts[row, column]
        level, lag = self.squares[row, column] / pairs, self.lags[row, column] / pairs
        basis = np.column_stack([np.ones(len(row)), 1.0 - np.exp(-lag[:, None] / LASTING), row])
        expected = basis @ PRIOR_SHARES
        total = max(float((contrasts * level).sum() / (contrasts * expected).sum()), LEAST_VARIANCE)
        # a squared normal variable has a variance of twice its squared mean
        noise = total * expected * np.sqrt(2.0 / contrasts)
        prior = 1.0 / (total * PRIOR_SPREAD)
        solved, _ = nnls(
            np.concatenate([basis / noise[:, None], np.eye(len(PRIOR_SHARES)) * prior]),
            np.concatenate([level / noise, PRIOR_SHARES * total * prior]),
        )
        # the mean of both answers, by how well either foretells the differences (Bayesian model averaging)
        only_new = np.zeros(len(PRIOR_SHARES))
        only_new[0] = max(float((contrasts * level).sum() / contrasts.sum()), LEAST_VARIANCE)
        odds = np.log(NOTHING_LASTS / (1.0 - NOTHING_LASTS))
        odds += _log_evidence(level - only_new[0], noise, basis[:, :1] / prior)
        odds -= _log_evidence(level - total * expected, noise, basis / prior)
        share = expit(odds)
        return np.asarray(share * only_new + (1.0 - share) * solved)


def _log_evidence(residual: Float, noise: Float, basis: Float) -> float:
    """Return the log-likelihood of residuals under noise and unknown multiples of basis functions, up to a constant.

    ``noise (n,)`` are deviations; ``basis (n, k)`` is times the deviation of its coefficient.
    """
    factor = np.linalg.cholesky(np.diag(noise**2) + basis @ basis.T)
    standard = solve_triangular(factor, residual, lower=True)
    return float(-0.5 * (standard @ standard) - np.log(np.diag(factor)).sum())


def line_deviations(curve: StationCurve, parts: Float, common: float) -> Float:
    """Return the standard deviation of fused stations across the line, metres, ``(n,)``.

    ``parts`` are of :meth:`ErrorModel.parts`; all detections of an element share the deviation ``common``, metres.
    """
    sums, marks = curve.sums, curve.marks
    mean, count = _mean_variance(parts, sums[:, OBSERVATIONS], marks[:, PLACES], marks[:, TRACKS])
    expected = _average(count * (1.0 - mean / parts.sum()).clip(0.0))
    noise = _noise(_average(sums[:, SCATTER]) / parts.sum(), expected)
    return np.asarray(np.sqrt(noise * mean * count / np.maximum(sums[:, INFORMATION], 1e-6) + common**2))


def ring_deviations(ring: FusedRing, information: Float, parts: Float, common: float) -> Float:
    """Return the standard deviation ``(n,)``, metres, of a crossing's outline at points of that information, 1 / m².

    ``parts`` and ``common`` are as in :func:`line_deviations`.
    """
    information = np.maximum(information, 1e-2)
    seen = float(ring.evidence.observations)
    mean, count = _mean_variance(parts, seen * information / information.max(), *ring.marks)
    noise = _noise(ring.scatter / parts.sum(), seen * np.maximum(1.0 - mean.min() / parts.sum(), 0.0))
    return np.asarray(np.sqrt(noise * mean * count / information + common**2 + RING_ROUNDING**2))


def _mean_variance(parts: Float, observations: Float, places: Marks, tracks: Marks) -> tuple[Float, Float]:
    """Return the variance of the mean of the observations of a station, and their number, at least 1.

    The variance is a multiple of that which one observation is assumed to have.
    """
    count = np.maximum(observations, 1.0)
    lasting = LASTING / (PLACE * distinct(places))[..., None]
    # variance of the mean of a process whose correlation falls off exponentially
    remains = 2.0 * lasting * (1.0 + lasting * np.expm1(-1.0 / lasting))
    return parts[0] / count + remains @ parts[1:-1] + parts[-1] / np.minimum(distinct(tracks), count), count


def _noise(found: Float | float, expected: Float | float) -> Float | float:
    """Return the ratio of an element's scatter to that expected for the whole map, drawn to 1 by the prior."""
    return (PRIOR_OBSERVATIONS + found) / (PRIOR_OBSERVATIONS + expected)


def _average(values: Float) -> Float:
    """Return running means over :data:`WINDOW` entries, fewer at the ends."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    at = np.arange(len(values))
    first, stop = np.maximum(at - WINDOW // 2, 0), np.minimum(at + WINDOW // 2 + 1, len(values))
    return np.asarray((total[stop] - total[first]) / (stop - first))
