"""Configuration of the integrator: assumptions about the detector and the road, each with its unit."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class IntegratorConfig:
    """Assumptions of :class:`mapfusion.MapIntegrator`.

    Attributes:
        station_spacing: distance between the vertices that carry the evidence of a line, metres.
        ring_cell: cell of the signed-distance grid in which crossings are fused, metres.
        deviation_near: standard deviation of a detection across the line beside the car, metres.
        deviation_per_metre: its growth with the distance from the car, metres per metre.
        common_deviation: what all detections of an element have in common, so that no number of them shows it, metres;
            known from a comparison with the truth only. It is in the stated uncertainty and changes nothing else.
        match_distance: largest mean lateral distance at which a detection can be an element, metres.
        match_angle: largest angle between their directions, degrees.
        match_overlap: shortest common stretch that identifies a line, metres (less for shorter lines).
        merge_distance: elements of one kind closer than this on average are one, unless single frames show both,
            metres.
        ring_overlap: smallest intersection over union at which two crossings match.
        rim: stations closer than this to the rim of the ROI do not count as looked at, metres.
        view_full, view_far, view_floor: up to ``view_full`` metres from the car a missing detection counts fully;
            the weight falls linearly to ``view_floor`` at ``view_far`` metres.
        prior_log_odds: log-odds that something seen never exists.
        hit_log_odds, miss_log_odds: what one sighting adds and one missed sighting takes.
        weak_log_odds: stretches of a line with less than even odds but more than this stay in the map where they
            continue a stretch with more than even odds.
        whole_sightings: a line with no stretch sighted this often is kept or dropped as a whole, by the median of its
            stretches: a false detection is false all along, also where the car hardly looked.
        max_deviation: stretches of a line whose place is known less well are left out of the map, metres.
        min_observations: elements seen in fewer frames are left out of the map.
        min_length: shorter lines are left out of the map, metres.
        min_area: smaller crossings are left out of the map, square metres.
        max_gap: stretches without evidence up to this length are bridged inside a line, metres.
        join_gap: ends of two lines that run into each other are joined up to this distance, metres; past ``max_gap``
            only where the car has hardly looked between them.
        join_views: sum of view weights up to which it has hardly looked.
        join_angle: largest angle between the lines at the joint, degrees.
        join_aside: how far they may miss each other sideways (twice as far at ``join_gap``), metres.
        join_overlap: how far the ends may reach past each other, metres.
        curvature_deviation: expected second difference of a line's vertices one metre apart, metres; smaller is
            smoother.
        simplify_tolerance: largest distance between the fused and the written line, metres.
        max_speed: frames of a log that imply a faster car are rejected, metres per second.
        max_points: lines with more vertices are rejected.
    """

    station_spacing: float = 1.0
    ring_cell: float = 0.5
    deviation_near: float = 0.15
    deviation_per_metre: float = 0.35 / 30.0
    common_deviation: float = 0.03
    match_distance: float = 1.2
    match_angle: float = 35.0
    match_overlap: float = 3.0
    merge_distance: float = 0.6
    ring_overlap: float = 0.3
    rim: float = 1.5
    view_full: float = 12.0
    view_far: float = 30.0
    view_floor: float = 0.4
    prior_log_odds: float = -1.2
    hit_log_odds: float = 1.0
    miss_log_odds: float = 0.7
    weak_log_odds: float = -1.0
    whole_sightings: float = 4.0
    max_deviation: float = 0.5
    min_observations: int = 2
    min_length: float = 2.0
    min_area: float = 2.0
    max_gap: float = 4.0
    join_gap: float = 8.0
    join_views: float = 3.0
    join_angle: float = 40.0
    join_aside: float = 1.0
    join_overlap: float = 5.0
    curvature_deviation: float = 0.1
    simplify_tolerance: float = 0.05
    max_speed: float = 100.0
    max_points: int = 10_000
