"""Everything that decides how a run trains."""

from __future__ import annotations

from dataclasses import dataclass, field

from predmapnet.training.augmentation import AugmentationSettings
from predmapnet.training.losses import LossWeights
from predmapnet.training.matching import MatchingCosts
from predmapnet.training.optimiser import OptimiserSettings


@dataclass(frozen=True)
class Budget:
    """How long a stage trains: until either limit is reached; progress is the larger part.

    Attributes:
        minutes: wall time, or None.
        steps: optimiser steps, or None.
    """

    minutes: float | None = None
    steps: int | None = None

    def progress(self, steps: int, seconds: float) -> float:
        """Return the part that is used up, 1 and more when it is over."""
        of_time = seconds / (self.minutes * 60) if self.minutes else 0.0
        of_steps = steps / self.steps if self.steps else 0.0
        return max(of_time, of_steps)


@dataclass(frozen=True)
class StreamSettings:
    """The temporal stage: streams that carry their state across optimiser steps.

    Attributes:
        streams: streams side by side in one process.
        frames: consecutive frames that share a gradient.
        longest: longest stream, frames; it grows from ``frames`` to this over ``growth_steps`` steps.
        growth_steps: see above.
        score: rows above it become tracks.
        track_dropout: probability that a track is forgotten.
        state_dropout: probability that a stream forgets everything.
        false_tracks: at most this many unassigned detections per frame become tracks.
        refresh: probability that a better-scored detection replaces its track's query and points.
        capacity: most tracks of a stream.
    """

    streams: int = 4
    frames: int = 2
    longest: int = 40
    growth_steps: int = 400
    score: float = 0.3
    track_dropout: float = 0.12
    state_dropout: float = 0.03
    false_tracks: int = 3
    refresh: float = 0.3
    capacity: int = 40


@dataclass(frozen=True)
class TrainingSettings:
    """One run.

    Attributes:
        batch: frames of one optimiser step of the single-frame stage, over all processes.
        seed: of weights, draws and augmentation.
        single, temporal: budgets of the two stages; None skips a stage.
        validation_minutes, checkpoint_minutes: intervals.
        log_steps: steps between two lines of metrics.
    """

    batch: int = 6
    seed: int = 0
    single: Budget | None = field(default_factory=Budget)
    temporal: Budget | None = None
    validation_minutes: float = 8.0
    checkpoint_minutes: float = 3.0
    log_steps: int = 20
    weights: LossWeights = field(default_factory=LossWeights)
    costs: MatchingCosts = field(default_factory=MatchingCosts)
    optimiser: OptimiserSettings = field(default_factory=OptimiserSettings)
    temporal_optimiser: OptimiserSettings = field(default_factory=lambda: OptimiserSettings(learning_rate=5e-4))
    augmentation: AugmentationSettings = field(default_factory=AugmentationSettings)
    streams: StreamSettings = field(default_factory=StreamSettings)
