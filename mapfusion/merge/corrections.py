"""Corrections of the poses of many maps from alignments of pairs: robust linear least squares."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import spsolve

from mapfusion.alignment import Alignment, move
from mapfusion.arrays import Float

PRIOR = np.array([1.0, 1.0, np.radians(0.5)])
"""Standard deviation of a drive's own pose: metres, metres, radians; holds each group of maps at its mean."""

HALF_WEIGHT = 0.5
"""Residual at which a pair of maps loses half its weight, metres."""

ROUNDS = 8
"""Number of rounds of reweighting."""


@dataclass(frozen=True)
class Correction:
    """Correction of one map: turned about its centre, then shifted.

    Attributes:
        centre: ``(2,)``, metres.
        shift: ``(2,)``, metres.
        turn: radians.
    """

    centre: Float = field(default_factory=lambda: np.zeros(2))
    shift: Float = field(default_factory=lambda: np.zeros(2))
    turn: float = 0.0

    def apply(self, points: Float) -> Float:
        """Move points ``(n, 2)``."""
        return move(points, self.centre, self.shift, self.turn)


def solve_corrections(centres: Float, pairs: Mapping[tuple[int, int], Alignment]) -> list[Correction]:
    """Distribute the motions between pairs over the maps.

    For each certain alignment of map ``i`` to map ``j`` about a point ``o``, turns being small,
    ``(t_i + a_i J (o - c_i)) - (t_j + a_j J (o - c_j)) = shift`` and ``a_i - a_j = turn``, weighted by the alignment's
    information; in rounds, pairs that contradict the rest lose weight (Cauchy).

    Args:
        centres: ``(n, 2)``, metres, a point of each map about which it turns.
        pairs: alignments that are certain, by numbers of maps.

    Returns:
        One correction per map; maps without a pair stay where they are.
    """
    count = len(centres)
    if not pairs:
        return [Correction()] * count
    keys = sorted(pairs)
    blocks = [_block(centres, key, pairs[key]) for key in keys]
    trust = np.ones(len(keys))
    solution = np.zeros(3 * count)
    for _ in range(ROUNDS):
        rows, columns, values = [np.arange(3 * count)], [np.arange(3 * count)], [np.tile(PRIOR**-2, count)]
        right = np.zeros(3 * count)
        for (first, second), (design, wanted, information), weight in zip(keys, blocks, trust, strict=True):
            index = np.concatenate([3 * first + np.arange(3), 3 * second + np.arange(3)])
            square = weight * design.T @ information @ design
            rows.append(np.repeat(index, 6))
            columns.append(np.tile(index, 6))
            values.append(square.ravel())
            right[index] += weight * design.T @ information @ wanted
        matrix = coo_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))))
        solution = spsolve(matrix.tocsc(), right)
        for place, ((first, second), (design, wanted, _)) in enumerate(zip(keys, blocks, strict=True)):
            index = np.concatenate([3 * first + np.arange(3), 3 * second + np.arange(3)])
            left = float(np.linalg.norm((design @ solution[index] - wanted)[:2]))
            trust[place] = 1.0 / (1.0 + (left / HALF_WEIGHT) ** 2)
    values_of = solution.reshape(count, 3)
    return [Correction(centre, row[:2], float(row[2])) for centre, row in zip(centres, values_of, strict=True)]


def _block(centres: Float, key: tuple[int, int], alignment: Alignment) -> tuple[Float, Float, Float]:
    """Return design ``(3, 6)``, wanted motion ``(3,)`` and information ``(3, 3)`` of one pair."""
    design = np.zeros((3, 6))
    for side, sign in ((0, 1.0), (1, -1.0)):
        lever = alignment.centre - centres[key[side]]
        block = np.array([[1.0, 0.0, -lever[1]], [0.0, 1.0, lever[0]], [0.0, 0.0, 1.0]])
        design[:, 3 * side : 3 * side + 3] = sign * block
    return design, np.append(alignment.shift, alignment.turn), alignment.information
