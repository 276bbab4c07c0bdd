"""Print how good the integrator and two baselines are: ``python -m tests.mapfusion.compare_integrators``."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import astuple

import numpy as np

from mapfusion import MapIntegrator
from tests.mapfusion.argoverse import LOGS, log_drive
from tests.mapfusion.baselines import LastObservationWins, PairwiseAveraging
from tests.mapfusion.map_quality import Quality, measure
from tests.mapfusion.simulation import Drive, town_drive

INTEGRATORS = (MapIntegrator, PairwiseAveraging, LastObservationWins)


def average(integrator: type, drives: Iterable[Drive]) -> Quality:
    """Return the mean figures of an integrator over several drives (ghosts: their sum)."""
    figures = []
    for drive in drives:
        one = integrator()
        for frame in drive.frames:
            one.add(frame)
        figures.append(astuple(measure(one.map(), drive)))
    mean = np.mean(figures, axis=0)
    return Quality(*mean[:4].tolist(), ghosts_alive=int(np.sum(figures, axis=0)[4]))


def main() -> None:
    """Print one table for the simulated towns, one for the real lines if they are at hand."""
    places = {"ten simulated town roads": [town_drive(seed) for seed in range(10)]}
    if LOGS.is_dir():
        places["two Argoverse 2 logs"] = [log_drive(log, seed) for log in sorted(LOGS.iterdir()) for seed in range(3)]
    for place, drives in places.items():
        print(f"\n{place}: 0.3 m noise, 20 % drop-outs, 10 % ghosts, 40 frames")
        print(f"{'':22}{'precision':>10}{'recall':>8}{'lateral':>9}{'elements':>10}{'ghosts':>8}")
        for integrator in INTEGRATORS:
            q = average(integrator, drives)
            print(
                f"{integrator.__name__:22}{q.precision:10.3f}{q.recall:8.3f}{q.lateral:7.3f} m"
                f"{q.elements_per_true:10.2f}{q.ghosts_alive:8d}"
            )


if __name__ == "__main__":
    main()
