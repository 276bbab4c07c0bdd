"""Print how good the integrator and two baselines are: ``python -m tests.mapfusion.compare_integrators``.

With ``--towns FOLDER`` also on what the shipped network sees in the ten test towns of the demo world; the frames are
kept in the folder for the next time.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import astuple
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mapfusion import MapIntegrator
from tests.mapfusion.argoverse import LOGS, log_drive
from tests.mapfusion.baselines import LastObservationWins, PairwiseAveraging
from tests.mapfusion.map_quality import Quality, measure
from tests.mapfusion.simulation import Drive, town_drive

if TYPE_CHECKING:
    from tests.mapfusion.demo_towns import MappedTown

Integrator = MapIntegrator | PairwiseAveraging | LastObservationWins
INTEGRATORS: tuple[type[Integrator], ...] = (MapIntegrator, PairwiseAveraging, LastObservationWins)

TUNING_SEEDS = range(10)
"""The assumptions of the integrator were chosen on these."""

HELD_OUT_SEEDS = range(200, 210)
"""Nobody has looked at these while choosing."""


def average(integrator: type[Integrator], drives: Iterable[Drive]) -> Quality:
    """Return the mean figures of an integrator over several drives (ghosts: their sum)."""
    figures = []
    for drive in drives:
        one = integrator()
        for frame in drive.frames:
            one.add(frame)
        figures.append(astuple(measure(one.map(), drive)))
    precision, recall, lateral, elements, _ = np.mean(figures, axis=0).tolist()
    return Quality(precision, recall, lateral, elements, ghosts_alive=int(np.sum(figures, axis=0)[4]))


def simulated(seeds: Sequence[int], baselines: bool) -> None:
    """Print figures on simulated detections: town roads, and the real lines if they are at hand."""
    places = {"simulated town roads": [town_drive(seed) for seed in seeds]}
    logs = sorted(path.parent for path in LOGS.glob("*/city_SE3_egovehicle.feather"))
    places |= {f"Argoverse 2 log {log.name[:8]}": [log_drive(log, seed) for seed in seeds] for log in logs}
    print(f"\nseeds {seeds[0]} to {seeds[-1]}: 0.3 m noise, 20 % drop-outs, 10 % ghosts, 40 frames; within 0.5 m")
    print(f"{'':26}{'':20}{'precision':>10}{'recall':>8}{'lateral':>9}{'elements':>10}{'ghosts':>8}")
    for place, drives in places.items():
        for integrator in INTEGRATORS if baselines else INTEGRATORS[:1]:
            q = average(integrator, drives)
            print(
                f"{place:26}{integrator.__name__:20}{q.precision:10.3f}{q.recall:8.3f}{q.lateral:7.3f} m"
                f"{q.elements_per_true:10.2f}{q.ghosts_alive:8d}"
            )


def demo_world(towns: Sequence[MappedTown], split: str) -> None:
    """Print figures on what the shipped network sees in towns of the demo world."""
    from predmapnet.evaluation.global_map import THRESHOLDS, global_map_quality, pool

    print(f"\n{len(towns)} {split} towns of the demo world, frames of the shipped weights")
    print(
        f"{'':20}{'P@0.5':>7}{'R@0.5':>7}{'P@1.0':>7}{'R@1.0':>7}{'lateral':>9}{'elements':>10}{'fragments':>11}"
        f"{'duplicates':>12}"
    )
    half, whole = THRESHOLDS.index(0.5), THRESHOLDS.index(1.0)
    for integrator in INTEGRATORS:
        qualities = []
        for town in towns:
            one = integrator()
            for frame in town.frames:
                one.add(frame.tracked)
            qualities.append(global_map_quality(one.map(), town.truth, town.seen))
        q = pool(qualities).overall
        print(
            f"{integrator.__name__:20}{q.precision[half]:7.3f}{q.recall[half]:7.3f}{q.precision[whole]:7.3f}"
            f"{q.recall[whole]:7.3f}{np.median(q.lateral_errors):7.3f} m{q.predicted_elements / q.true_elements:10.2f}"
            f"{q.fragments / q.followed:11.2f}{q.duplicates:12d}"
        )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10, choices=range(1, 11), help="drives per figure", metavar="N")
    parser.add_argument("--towns", type=Path, metavar="FOLDER", help="also map the demo world, frames kept here")
    parser.add_argument("--split", default="test", choices=("test", "val"), help="which of its towns")
    options = parser.parse_args()
    simulated(TUNING_SEEDS[: options.seeds], baselines=False)
    simulated(HELD_OUT_SEEDS[: options.seeds], baselines=True)
    if options.towns is not None:
        from tests.mapfusion.demo_towns import mapped_towns

        demo_world(list(mapped_towns(options.towns, options.split)), options.split)


if __name__ == "__main__":
    main()
