"""Stability of the online map from frame to frame: presence, localisation, shape, and their mean mAS.

What the public toolbox of the ICLR 2026 benchmark *Stability Under Scrutiny* computes. An element that two frames share
is an instance with three values: *presence* (0.2 if it appears, else 1), *localisation* (1 minus the mean lateral
offset of its two predictions, 15 m counting as 1) and *shape* (1 minus the difference of their mean turning angles,
pi counting as 1); its stability is ``presence * (localisation + shape) / 2``. Classes are averaged plainly, and a class
without instances counts as 0. Frames two apart are compared, which is one second on nuScenes.

The toolbox computes two different things, depending on the format of its input, and their figures cannot be compared:
instances *anchored* in the ground truth, and *paired* predictions without any. In the anchored protocol a defect scores
only as many instances as there are frame pairs, with the poses of other pairs; :class:`Protocol` leaves it out unless
the published figure is asked for. In everything else the toolbox is followed, also where it surprises: a line is read
as a function of x by a walk that never turns back, so that its direction matters; an instance that vanishes costs no
presence; matches have no limit. It is not known with which protocol and interval the paper's tables were made.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapfusion.arrays import Bool, Float, Integer
from mapfusion.elements import ElementKind
from predmapnet.evaluation.frames import EvaluationFrame
from predmapnet.evaluation.stability_matching import (
    SceneInstances,
    anchored_instances,
    padded_lines,
    paired_instances,
)
from predmapnet.evaluation.stability_protocol import Protocol
from predmapnet.evaluation.stability_values import localisation_and_shape, presence

INTERVAL = 2
"""Frames from the previous to the current one."""
LOCALISATION_WEIGHT = 0.5
UNDETECTED = np.float32(0.01)
"""Instances whose scores are below this in both frames do not count."""
VALUES = ("presence", "localisation", "shape", "stability")


@dataclass(frozen=True)
class Stability:
    """Values of all instances.

    Attributes:
        protocol: that was followed.
        interval: frames from the previous to the current one.
        frame_pairs: number of frame pairs.
        kinds: ``(m,)``.
        presence, localisation, shape, stability: ``(m,)``, in [0, 1].
        counted: ``(m,)``, whether an instance was detected in at least one of its frames.
    """

    protocol: Protocol
    interval: int
    frame_pairs: int
    kinds: Integer
    presence: Float
    localisation: Float
    shape: Float
    stability: Float
    counted: Bool

    @property
    def mean(self) -> float:
        """The mAS: mean of the stability over all three kinds."""
        return self.mean_of("stability")

    def mean_of(self, value: str, kind: ElementKind | None = None) -> float:
        """Mean of one of VALUES over the instances of a kind, 0 if it has none; or over all three kinds."""
        if kind is None:
            return float(np.mean([self.mean_of(value, each) for each in ElementKind]))
        values: Float = getattr(self, value)[self.counted & (self.kinds == kind)]
        return float(values.mean()) if len(values) else 0.0

    def figures(self) -> dict[str, object]:
        """Nested figures as written to JSON: ``mAS``, ``presence``, ``localisation``, ``shape``, and per kind."""
        figures: dict[str, object] = {
            "protocol": self.protocol.value,
            "interval": self.interval,
            "frame_pairs": self.frame_pairs,
            "mAS": self.mean,
        }
        figures |= {value: self.mean_of(value) for value in VALUES[:-1]}
        for kind in ElementKind:
            entry: dict[str, float | int] = {value: self.mean_of(value, kind) for value in VALUES}
            figures[kind.label] = entry | {"instances": int((self.counted & (self.kinds == kind)).sum())}
        return figures


def scene_instances(
    frames: Sequence[EvaluationFrame],
    truth_ids: Sequence[Integer],
    protocol: Protocol = Protocol.ANCHORED,
    interval: int = INTERVAL,
) -> SceneInstances:
    """Find the instances of one scene, the costly part, in all of its frames in order.

    ``truth_ids`` are per frame ``(g,)`` ids of the true elements, unique per kind; paired instances ignore them.
    """
    if protocol is Protocol.PAIRED:
        return paired_instances(frames, interval)
    return anchored_instances(frames, truth_ids, interval)


def stability(
    scenes: Sequence[tuple[Sequence[EvaluationFrame], SceneInstances]],
    protocol: Protocol = Protocol.ANCHORED,
    interval: int = INTERVAL,
    weight: float = LOCALISATION_WEIGHT,
) -> Stability:
    """Compute the values of all instances: frames of each scene, in the data set's order, and what was found there.

    Args:
        scenes: frames and their :func:`scene_instances`.
        protocol, interval: with which the instances were found.
        weight: of the localisation; the shape has the rest.
    """
    frames = [frame for scene, _ in scenes for frame in scene]
    first_frame = np.cumsum([0, *(len(scene) for scene, _ in scenes)])
    pairs = [found.pairs + start for (_, found), start in zip(scenes, first_frame, strict=False)]
    own_pairs = [pairs_of[found.pair] for pairs_of, (_, found) in zip(pairs, scenes, strict=True)]
    none = np.zeros((0, 2), dtype=np.int64)
    own, poses_of = np.concatenate([none, *own_pairs]), np.concatenate([none, *own_pairs])
    rows = np.concatenate([none, *(found.predictions for _, found in scenes)])
    kinds = np.concatenate([none[:, 0], *(found.kinds for _, found in scenes)])
    if protocol is Protocol.PUBLISHED:
        # The defect: as many instances as there are pairs, and instance k gets the poses of pair k.
        poses_of = np.concatenate([none, *pairs])
        own, rows, kinds = (values[: len(poses_of)] for values in (own, rows, kinds))
    scores = _scores(frames, own, rows)
    poses = np.array([frame.predicted.ego_to_global for frame in frames]).reshape(-1, 4, 4)
    near, alike = localisation_and_shape(*_lines(frames, own, rows, protocol), poses, poses_of)
    there = presence(scores[:, 0], scores[:, 1])
    together = np.clip(weight * near + (1.0 - weight) * alike, 0.0, 1.0)
    return Stability(
        protocol,
        interval,
        sum(found.frame_pairs for _, found in scenes),
        kinds,
        there,
        near,
        alike,
        np.clip(there * together, 0.0, 1.0),
        np.asarray((scores >= UNDETECTED).any(axis=1)),
    )


def _scores(frames: Sequence[EvaluationFrame], own: Integer, rows: Integer) -> NDArray[np.float32]:
    """Scores ``(m, 2)`` of the current and the previous prediction; 0 for none."""
    first = _first_lines(frames)
    scores = np.concatenate([np.zeros(0), *(frame.predicted.scores for frame in frames)]).astype(np.float32)
    matched = rows >= 0
    found = np.zeros(rows.shape, dtype=np.float32)
    found[matched] = scores[(first[own] + rows)[matched]]
    return found


def _lines(
    frames: Sequence[EvaluationFrame], own: Integer, rows: Integer, protocol: Protocol
) -> tuple[Float, Integer, Integer]:
    """Vertices of all predicted lines, where each begins, and the two lines ``(m, 2)`` of each instance."""
    if protocol is Protocol.PAIRED:
        lines = [line for frame in frames for line in padded_lines(frame)]
    else:
        lines = [line for frame in frames for line in frame.predicted.polylines]
    points = np.concatenate([np.zeros((0, 2)), *lines])
    offsets = np.cumsum([0, *(len(line) for line in lines)])
    return points, offsets, np.where(rows >= 0, _first_lines(frames)[own] + rows, -1)


def _first_lines(frames: Sequence[EvaluationFrame]) -> Integer:
    return np.cumsum([0, *(len(frame.predicted) for frame in frames)])
