"""Alignment of two maps of one place by trimmed point-to-line ICP, refused where it is not certain."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from mapfusion.arrays import Bool, Float, Integer, Rows
from mapfusion.elements import ElementKind, GlobalMap
from mapfusion.stretches import Samples, sample_lines

TURNS = np.radians([0.0, 0.6, -0.6, 1.2, -1.2])
"""Turns that are tried around each of :data:`BASES`, radians."""

BASES = np.radians([0.0, 2.4, -2.4])
"""Turns around which is searched, radians; all but the first only if that one finds no good agreement."""

SEARCH_SAMPLES = 150
"""Number of samples that vote for a shift."""

VOTE_CELL, VOTE_BLUR = 0.5, 0.6
"""Side of a cell of shifts and the standard deviation of a vote, metres."""

COMMON = 8.0
"""Samples with a line of their kind this close lie in common ground, metres."""

RIVAL_DISTANCE = 2.0
"""Shifts this far from the best one, and up to twice as far, are another answer, metres."""


@dataclass(frozen=True)
class AlignmentConfig:
    """Conditions under which an alignment is believed.

    Attributes:
        spacing: distance between the samples of a line, metres.
        reach: largest shift that is looked for along each axis, metres.
        close: samples within this distance after the correction agree, metres.
        min_overlap: shared length that it takes, metres.
        min_agreement: share of the samples in common ground that must agree.
        min_hold: length of line, projected across the worst direction, that must hold the correction, metres; with
            parallel lines only, nothing holds along them.
        max_residual: largest root mean square of the trimmed residuals, metres.
        max_turn: largest rotation, degrees.
        rival_ratio: another shift, at least 2 m away, whose agreement reaches this share of the best makes the
            choice uncertain (lanes repeat).
        correlation: neighbouring samples err alike; this many count as one.
    """

    spacing: float = 1.0
    reach: float = 7.0
    close: float = 0.75
    min_overlap: float = 40.0
    min_agreement: float = 0.6
    min_hold: float = 10.0
    max_residual: float = 0.5
    max_turn: float = 4.0
    rival_ratio: float = 0.9
    correlation: float = 10.0


@dataclass(frozen=True)
class Alignment:
    """Rigid motion of the plane that puts one map on another.

    Attributes:
        centre: ``(2,)``, metres; the motion is ``p -> centre + R(turn) (p - centre) + shift``.
        shift: ``(2,)``, metres.
        turn: radians, counter-clockwise.
        information: ``(3, 3)`` inverse covariance of shift and turn.
        overlap: shared length, metres.
        residual: root mean square of the trimmed residuals, metres.
        refusal: why it is not certain, empty if it is.
        disagrees: whether the maps share ground and yet contradict each other there.
    """

    centre: Float
    shift: Float
    turn: float
    information: Float = field(default_factory=lambda: np.zeros((3, 3)))
    overlap: float = 0.0
    residual: float = 0.0
    refusal: str = ""
    disagrees: bool = False

    @property
    def certain(self) -> bool:
        """Whether the motion may be used."""
        return not self.refusal

    def apply(self, points: Float) -> Float:
        """Move points ``(n, 2)``, metres."""
        return move(points, self.centre, self.shift, self.turn)


def move(points: Float, centre: Float, shift: Float, turn: float) -> Float:
    """Turn points ``(n, 2)`` about ``centre`` by ``turn`` radians and shift them."""
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    return np.asarray((points - centre) @ rotation.T + centre + shift)


@dataclass(frozen=True)
class Landmarks:
    """Samples of a map with directions and kinds, and a tree over each kind."""

    samples: Samples
    kinds: Integer
    trees: dict[int, tuple[Rows, cKDTree]]


def landmarks(global_map: GlobalMap, config: AlignmentConfig | None = None) -> Landmarks:
    """Sample a map for :func:`align`, so that a map that meets many others is sampled once."""
    config = config or AlignmentConfig()
    elements = [element for element in global_map if element.length > config.spacing]
    samples = sample_lines([element.points for element in elements], config.spacing)
    kinds = np.array([int(element.kind) for element in elements], dtype=np.int64)[samples.line]
    trees = {}
    for kind in ElementKind:
        rows = np.flatnonzero(kinds == kind)
        if len(rows):
            trees[int(kind)] = (rows, cKDTree(samples.points[rows]))
    return Landmarks(samples, kinds, trees)


def align(source: Landmarks, target: Landmarks, config: AlignmentConfig | None = None) -> Alignment:
    """Find the rigid motion that puts ``source`` on ``target`` (both of :func:`landmarks`), and whether to believe it.

    Pairs of samples of one kind vote for the shift between them (from several turns, if need be); the best shift is
    refined by Gauss-Newton on distances across lines, the worst fifth left out.
    """
    config = config or AlignmentConfig()
    everything = np.arange(len(source.samples))
    common = everything[_nearest(source, target, everything, source.samples.points, COMMON)[0] >= 0]
    overlap = float(source.samples.spacing[common].sum())
    if overlap < config.min_overlap:
        refusal = f"only {overlap:.0f} m of lines in common ground"
        return Alignment(np.zeros(2), np.zeros(2), 0.0, overlap=overlap, refusal=refusal)
    centre = source.samples.points[common].mean(axis=0)
    best: Alignment | None = None
    for base in BASES:
        result = _refine(source, target, common, _search(source, target, common, centre, base, config), config)
        if best is None or result.overlap > best.overlap:
            best = result
        if best.overlap > 0.8 * overlap:
            break
    assert best is not None
    refusal, disagrees = _doubt(best, best.overlap / overlap, _rival(source, target, common, best), config)
    return replace(best, refusal=refusal, disagrees=disagrees)


def _search(
    source: Landmarks, target: Landmarks, common: Rows, centre: Float, base: float, config: AlignmentConfig
) -> Alignment:
    """Return the motion, unrefined, that most samples vote for, among turns around ``base``."""
    reach = round(config.reach / VOTE_CELL)
    points, partners = _voters(source, target, common, Alignment(centre, np.zeros(2), base), config.reach + 2.0)
    best, found = -1.0, Alignment(centre, np.zeros(2), base)
    # of two shifts that fit as well the smaller one
    apart = np.hypot(*np.meshgrid(*[np.arange(-reach, reach + 1)] * 2, indexing="ij"))
    likely = np.exp(-0.125 * (apart / reach) ** 2)
    for turn in base + TURNS:
        votes = _vote(partners - move(points, centre, np.zeros(2), turn), reach) * likely
        if votes.max() > best:
            best = float(votes.max())
            cell = np.array(np.unravel_index(np.argmax(votes), votes.shape), dtype=np.float64)
            found = Alignment(centre, (cell - reach) * VOTE_CELL, float(turn))
    return found


def _rival(source: Landmarks, target: Landmarks, common: Rows, motion: Alignment) -> float:
    """Return the votes for the best other place after a motion, as a share of those for staying."""
    reach = round(2 * RIVAL_DISTANCE / VOTE_CELL)
    points, partners = _voters(source, target, common, motion, 2 * RIVAL_DISTANCE + 1.0)
    votes = _vote(partners - motion.apply(points), reach)
    apart = np.hypot(*np.meshgrid(*[np.arange(-reach, reach + 1) * VOTE_CELL] * 2, indexing="ij"))
    return float(votes[apart >= RIVAL_DISTANCE].max() / max(votes[reach, reach], 1e-9))


def _voters(source: Landmarks, target: Landmarks, common: Rows, motion: Alignment, reach: float) -> tuple[Float, Float]:
    """Return pairs of points of the source and the target, ``(n, 2)`` each, that one motion brings within reach."""
    thin = common[:: max(1, len(common) // SEARCH_SAMPLES)]
    moved = motion.apply(source.samples.points[thin])
    own, others = [np.empty(0, dtype=np.int64)], [np.empty(0, dtype=np.int64)]
    for kind, (members, tree) in target.trees.items():
        rows = np.flatnonzero(source.kinds[thin] == kind)
        if len(rows):
            near = cKDTree(moved[rows]).sparse_distance_matrix(tree, reach, output_type="ndarray")
            own.append(thin[rows[near["i"]]])
            others.append(members[near["j"]])
    first, second = np.concatenate(own), np.concatenate(others)
    alike = _alike(source.samples.tangents[first], target.samples.tangents[second])
    return source.samples.points[first[alike]], target.samples.points[second[alike]]


def _vote(offsets: Float, reach: int) -> Float:
    """Count votes for shifts ``(n, 2)``, metres, on a grid of ``2 reach + 1`` cells a side, blurred."""
    side = 2 * reach + 1
    cells = np.rint(offsets / VOTE_CELL).astype(np.int64) + reach
    cells = cells[((cells >= 0) & (cells < side)).all(axis=1)]
    votes = np.bincount(cells[:, 0] * side + cells[:, 1], minlength=side * side).reshape(side, side)
    return np.asarray(gaussian_filter(votes.astype(np.float64), VOTE_BLUR / VOTE_CELL, mode="constant"))


def _refine(source: Landmarks, target: Landmarks, common: Rows, start: Alignment, config: AlignmentConfig) -> Alignment:
    """Refine shift and turn."""
    shift, turn = start.shift, start.turn
    for reach in (3.0, 2.0, 1.5, 1.0, config.close, config.close, config.close):
        step, information, residual, agreed = _step(source, target, common, start.centre, shift, turn, reach, config)
        shift, turn = shift + step[:2], turn + float(step[2])
        if reach == config.close and np.abs(step).max() < 1e-4:
            break
    shared = float(source.samples.spacing[common][agreed].sum())
    return Alignment(start.centre, shift, turn, information, shared, residual)


def _doubt(result: Alignment, agreement: float, rival: float, config: AlignmentConfig) -> tuple[str, bool]:
    """Return why an alignment is not believed (empty if it is), and whether the maps contradict each other."""
    if result.overlap < config.min_overlap:
        return f"only {result.overlap:.0f} m of lines agree", agreement < config.min_agreement
    if agreement < config.min_agreement:
        return f"only {100 * agreement:.0f} % of the common ground agrees", True
    if result.residual > config.max_residual:
        return f"the lines still lie {result.residual:.2f} m apart", True
    variance = result.residual**2 + 0.05**2
    hold = np.linalg.eigvalsh(result.information[:2, :2])[0] * variance * config.correlation * config.spacing
    if hold < config.min_hold:
        return "nothing but parallel lines: the shift along them cannot be told", False
    if rival > config.rival_ratio:
        return "another shift fits as well (lines repeat)", False
    limit = np.radians(config.max_turn)
    if abs(result.turn) > limit or np.abs(result.shift).max() > config.reach + 1.0:
        return f"the maps would have to move by {np.linalg.norm(result.shift):.1f} m", False
    return "", False


def _alike(first: Float, second: Float) -> Bool:
    """Whether directions ``(n, 2)`` are the same, either way."""
    return np.asarray(np.abs((first * second).sum(axis=1)) > np.cos(np.radians(30.0)))


def _nearest(
    source: Landmarks, target: Landmarks, chosen: Rows, points: Float, reach: float
) -> tuple[Integer, Float, Float]:
    """Return the nearest target sample of their kind for some samples of the source, moved to ``points``.

    That is ``(n,)`` rows (-1 for none or for another direction), distances across the line and ``(n, 2)`` unit normals.
    """
    rows = np.full(len(points), -1, dtype=np.int64)
    for kind, (members, tree) in target.trees.items():
        own = np.flatnonzero(source.kinds[chosen] == kind)
        if len(own):
            distance, nearest = tree.query(points[own], distance_upper_bound=reach)
            hit = np.isfinite(distance)
            rows[own[hit]] = members[nearest[hit]]
    tangent = target.samples.tangents[np.maximum(rows, 0)] if len(target.samples) else np.zeros((len(points), 2))
    rows[~_alike(source.samples.tangents[chosen], tangent)] = -1
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    base = target.samples.points[np.maximum(rows, 0)] if len(target.samples) else points
    return rows, ((base - points) * normal).sum(axis=1), normal


def _step(
    source: Landmarks,
    target: Landmarks,
    common: Rows,
    centre: Float,
    shift: Float,
    turn: float,
    reach: float,
    config: AlignmentConfig,
) -> tuple[Float, Float, float, Bool]:
    """One trimmed Gauss-Newton step.

    Returns the change of shift and turn ``(3,)``, its information ``(3, 3)``, the root mean square residual in metres,
    and which of the common samples agree.
    """
    moved = move(source.samples.points[common], centre, shift, turn)
    rows, across, normal = _nearest(source, target, common, moved, float(np.hypot(reach, config.spacing)))
    agreed = (rows >= 0) & (np.abs(across) < reach)
    if np.count_nonzero(agreed) < 3:
        return np.zeros(3), np.zeros((3, 3)), np.inf, agreed
    residual = np.abs(across[agreed])
    kept = np.flatnonzero(agreed)[residual <= np.quantile(residual, 0.8)]
    lever = moved[kept] - centre - shift
    side = np.stack([-lever[:, 1], lever[:, 0]], axis=1)
    design = np.column_stack([normal[kept], (normal[kept] * side).sum(axis=1)])
    normal_matrix = design.T @ design
    # a whisper of a prior keeps the step finite where parallel lines leave a direction open
    step = np.linalg.solve(normal_matrix + np.diag([1e-3, 1e-3, 1e-1]), design.T @ across[kept])
    left = across[kept] - design @ step
    rms = float(np.sqrt((left**2).mean()))
    return step, normal_matrix / ((rms**2 + 0.05**2) * config.correlation), rms, agreed
