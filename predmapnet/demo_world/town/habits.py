"""Habits of a town, which all of its streets have in common."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from predmapnet.demo_world.world import CrossingStyle

SURFACES = ("brick", "paving", "red_asphalt", "green_asphalt", "slab")
"""Materials of crossings that are paved otherwise than the road."""


@dataclass(frozen=True)
class Habits:
    """Habits of a town in building and painting its streets.

    Attributes:
        left_hand: traffic keeps to the left.
        centre_colour: of the paint between opposite directions and beside medians.
        crossing_styles: drawn from with equal chance.
        ring_share: share of junctions with a crossing over every arm.
        bare_share: share of junctions without any crossing.
        overhang: how far crossings reach over the kerb, metres, least and most.
        openings: driveways and the like per metre of kerb.
        walkway_width: metres.
        grass_share: share of stretches with a verge instead of a sidewalk.
        edge_line_share: share of streets with a line along the kerb.
        unmarked_share: share of small streets without paint between the directions.
        lane_width: usual width of a lane, metres.
        stop_line_share: share of crossings with a stop line before them.
        bare_stop_share: share of arms without a crossing that have one.
        crossing_surface, surfaced_share: material of some crossings, and which share of them; empty for the road's own.
        worn_share: share of crossings whose paint is mostly gone.
        broad_share: share of streets that are broad, with parked rows along both kerbs.
    """

    left_hand: bool
    centre_colour: str
    crossing_styles: tuple[CrossingStyle, ...]
    ring_share: float
    bare_share: float
    overhang: tuple[float, float]
    openings: float
    walkway_width: float
    grass_share: float
    edge_line_share: float
    unmarked_share: float
    lane_width: float
    stop_line_share: float
    bare_stop_share: float
    crossing_surface: str
    surfaced_share: float
    worn_share: float
    broad_share: float

    @classmethod
    def draw(cls, random: Generator) -> Habits:
        """Draw the habits of a town: three quarters paint the centre yellow, a sixth drive on the left."""
        styles = list(CrossingStyle)
        first, second = styles[random.choice(3, p=[0.35, 0.3, 0.35])], styles[random.integers(3)]
        reaches_over = random.random() < 0.6
        return cls(
            left_hand=bool(random.random() < 0.17),
            centre_colour="yellow" if random.random() < 0.75 else "white",
            crossing_styles=(first, first, second),
            ring_share=float(random.uniform(0.2, 0.65)),
            bare_share=float(random.uniform(0.15, 0.6)),
            overhang=(0.0, 1.3) if reaches_over else (-0.4, 0.0),
            openings=float(np.exp(random.uniform(np.log(0.003), np.log(0.017)))),
            walkway_width=float(random.choice([random.uniform(1.6, 3.6), random.uniform(3.6, 6.5)], p=[0.7, 0.3])),
            grass_share=float(random.uniform(0.0, 0.5)),
            edge_line_share=float(random.uniform(0.0, 0.5)),
            unmarked_share=float(random.uniform(0.2, 0.7)),
            lane_width=float(random.uniform(2.9, 3.5)),
            stop_line_share=float(random.uniform(0.2, 0.9)),
            bare_stop_share=float(random.uniform(0.15, 0.9)),
            crossing_surface=str(random.choice(["", *SURFACES], p=[0.6, 0.12, 0.1, 0.1, 0.04, 0.04])),
            surfaced_share=float(random.uniform(0.2, 1.0)),
            worn_share=float(random.choice([0.0, random.uniform(0.1, 0.8)], p=[0.4, 0.6])),
            broad_share=float(random.choice([0.0, random.uniform(0.2, 0.9)], p=[0.5, 0.5])),
        )
