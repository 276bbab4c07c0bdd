"""Manner of a town: how full its kerbs are, how high, and how well they are to be seen."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from predmapnet.demo_world.world import Clutter

FAINT_KERBS = ((0.36, 0.34, 0.16, 0.14), (0.08, 0.37, 0.33, 0.22), (0.05, 0.20, 0.35, 0.40))
"""Shares of light, grey, dark and no kerbs: as usual, with little contrast, with hardly any."""

FLUSH_SHARE, KERB_HEIGHTS = 0.15, (0.05, 0.20)
"""Share of towns whose sidewalks lie in the plane of the road, and the range of heights in all others, metres."""


class Manner(NamedTuple):
    """Habits of a town beside its road; the defaults stand where nothing was drawn.

    Attributes:
        parked: share of the places in parking strips that are taken; None leaves it to the day.
        gaps: share of the strips, of up to 24 m, that stay empty.
        paved_alike: sidewalks are of the same asphalt as the road.
        kerbs: as in :class:`predmapnet.demo_world.world.Clutter`.
        kerb_height: metres.
    """

    parked: float | None = None
    gaps: float = 0.0
    paved_alike: bool = False
    kerbs: tuple[float, float, float, float] = Clutter().kerbs
    kerb_height: float = 0.0

    @classmethod
    def draw(cls, seed: int) -> Manner:
        """Draw a town's manner: half of the towns are parked full, a quarter pave sidewalks as roads."""
        random = np.random.default_rng([seed, 67])
        full = random.random() < 0.5
        return cls(
            parked=float(random.uniform(0.85, 0.99)) if full else None,
            gaps=float(random.uniform(0.05, 0.3)),
            paved_alike=bool(random.random() < 0.25),
            kerbs=FAINT_KERBS[random.choice(3, p=[0.45, 0.35, 0.2])],
            kerb_height=float(random.uniform(*KERB_HEIGHTS)) if random.random() >= FLUSH_SHARE else 0.0,
        )
