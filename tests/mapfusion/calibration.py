"""Print how often the truth lies within the stated uncertainty: ``python -m tests.mapfusion.calibration``.

With ``--towns FOLDER`` for what the shipped network sees in the towns of the demo world; the frames are kept in the
folder for the next time.

What is stated: the standard deviation of each vertex of a line across it. What is measured: of all points of the true
lines that the drive has looked at and whose line is in the map, the share that lies within 1.96 such deviations of the
map's line; 95 % if the deviations are honest and errors are normal.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import shapely

from mapfusion import ElementKind, GlobalMap, MapIntegrator
from mapfusion.arrays import Float
from mapfusion.geometry import arc_length
from tests.mapfusion.argoverse import LOGS, log_drive
from tests.mapfusion.map_quality import dense, looked_at
from tests.mapfusion.simulation import Detector, Drive, town_drive

if TYPE_CHECKING:
    from tests.mapfusion.demo_towns import MappedTown


BAND = 1.96
"""Deviations to either side that hold 95 % of a normal distribution."""

REACH = 1.5
"""A true point farther from every line of its kind is missing from the map, which is not the deviation's fault, m."""

CORRELATIONS = {
    "independent": Detector(),
    "per track": Detector(track_share=0.4),
    "slowly varying": Detector(slow_share=0.5),
    "both": Detector(track_share=0.25, slow_share=0.35),
}
"""What of the detector's variance lasts."""


def standard_errors(fused: GlobalMap, drive: Drive | MappedTown) -> Float:
    """Return the distance of true points to the map's lines across them, in deviations stated there.

    Args:
        fused: a map with deviations.
        drive: what is true; each point of a true line that three frames have looked at and that has a line of its kind
            within :data:`REACH` counts, unless it lies past the end of that line.

    Returns:
        ``(n,)``.
    """
    found = [np.empty(0)]
    for kind in ElementKind:
        elements = fused.of_kind(kind)
        points = [dense(element.points)[::2] for element in drive.truth.of_kind(kind)]
        points = [p[looked_at(p, drive) >= 3] for p in points]
        if not elements or not points:
            continue
        lines = np.array([shapely.LineString(element.points) for element in elements])
        where = shapely.points(np.concatenate(points))
        (row, line), distance = shapely.STRtree(lines).query_nearest(
            where, max_distance=REACH, return_distance=True, all_matches=False
        )
        along = shapely.line_locate_point(lines[line], where[row])
        inner = (along > 0.5) & (along < shapely.length(lines[line]) - 0.5)
        for number, element in enumerate(elements):
            own = (line == number) & (inner | kind.is_ring)
            assert element.deviation is not None
            found.append(distance[own] / np.interp(along[own], arc_length(element.points), element.deviation))
    return np.concatenate(found)


def errors_of(drives: list[Drive]) -> Float:
    """Return the errors in deviations over several drives, each integrated by itself."""
    found = []
    for drive in drives:
        integrator = MapIntegrator()
        for frame in drive.frames:
            integrator.add(frame)
        found.append(standard_errors(integrator.map(), drive))
    return np.concatenate(found)


def share_inside(errors: Float) -> float:
    """Return which share of the errors lies within the 95 % band."""
    return float((errors < BAND).mean())


def drives_of(place: str, detector: Detector, frames: int, seeds: range) -> list[Drive]:
    """Return drives of one place: ``towns`` or ``Argoverse 2``."""
    if place == "towns":
        return [town_drive(seed, frames, detector) for seed in seeds]
    logs = sorted(path.parent for path in LOGS.glob("*/city_SE3_egovehicle.feather"))
    return [log_drive(log, seed, frames, detector) for log in logs for seed in seeds[: (len(seeds) + 1) // 2]]


def print_towns(folder: Path) -> None:
    """Print the share for the shipped network, over all scenes of a split."""
    from predmapnet.mapping import NETWORK_ERRORS
    from tests.mapfusion.demo_towns import mapped_towns

    for split in ("val", "test"):
        found = []
        for town in mapped_towns(folder, split):
            integrator = MapIntegrator(NETWORK_ERRORS)
            for frame in town.frames:
                integrator.add(frame, town.name)
            found.append(standard_errors(integrator.map(), town))
        print(
            f"shipped network, {split} towns of the demo world: {share_inside(np.concatenate(found)):.1%}", flush=True
        )


def main() -> None:
    """Print a table: rows are places, lengths of the drive and correlations, columns the noise of a frame."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--seeds", type=int, default=4, help="drives per figure")
    parser.add_argument("--frames", type=int, nargs="+", default=[10, 20, 40])
    parser.add_argument("--noise", type=float, nargs="+", default=[0.1, 0.2, 0.3, 0.5], help="metres per frame")
    parser.add_argument("--towns", type=Path, help="only the shipped network; its frames are kept in this folder")
    options = parser.parse_args()
    if options.towns:
        return print_towns(options.towns)
    print("share of true points inside the stated 95 % band, by noise per frame")
    print(f"{'':13}{'frames':>7}  {'errors':16}" + "".join(f"{noise:8.1f} m" for noise in options.noise))
    for place in ("towns", *(["Argoverse 2"] if LOGS.is_dir() else [])):
        for frames in options.frames:
            for name, kind in CORRELATIONS.items():
                shares = []
                for noise in options.noise:
                    drives = drives_of(place, kind.scaled(noise), frames, range(100, 100 + options.seeds))
                    shares.append(share_inside(errors_of(drives)))
                print(f"{place:13}{frames:7d}  {name:16}" + "".join(f"{share:9.1%} " for share in shares), flush=True)


if __name__ == "__main__":
    main()
