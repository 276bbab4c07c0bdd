"""Configuration of a merge; every value has a unit and a reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class MergeConfig:
    """Assumptions of a merge.

    Attributes:
        match_distance: stretches of different maps are one line if they lie this close, metres.
        min_new: a stretch shorter than this beside a known line is noise, metres.
        default_deviation: of a line whose file states none and that one frame saw, metres.
        default_alike: share in the variance of such a line that is the same in all frames of a drive.
        floor_deviation: no map is trusted to be better than this, since its poses err as a whole, metres.
        miss_log_odds: what each frame takes from a line that the drive lacks though it looked there. Less than in one
            drive, since what hides a line in one frame often hides it in the next.
        miss_limit: the most that one map can take.
        hit_log_odds: the most that each frame of a drive that saw a line can add, whatever confidence the file states.
        log_odds_limit: more evidence than this from one map does not make it surer.
        tile, margin: side of a tile, and how far beyond its sides it looks, metres.
        simplify_tolerance: of the finished lines, metres.
        min_length: shorter lines are left out, metres.
        ring_overlap: intersection over union from which two crossings are one.
        max_partners: a map is aligned with at most this many others, those that share most ground.
        max_gap: gaps in the evidence up to this length are bridged, metres.
        at_most: number of maps to take, those that add most (:mod:`mapfusion.merge.choice`); None takes all.
    """

    match_distance: float = 1.5
    min_new: float = 2.0
    default_deviation: float = 0.4
    default_alike: float = 0.1
    floor_deviation: float = 0.05
    miss_log_odds: float = 0.15
    miss_limit: float = 2.0
    hit_log_odds: float = 1.0
    log_odds_limit: float = 4.0
    tile: float = 200.0
    margin: float = 40.0
    simplify_tolerance: float = 0.05
    min_length: float = 1.0
    ring_overlap: float = 0.25
    max_partners: int = 12
    max_gap: float = 5.0
    at_most: int | None = None
