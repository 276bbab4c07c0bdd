"""What merging makes of drives with bad poses: ``python -m tests.benchmarks.merge_under_noise [--json FILE]``.

Drives over towns of the demo world and the Argoverse 2 logs below ``$PREDMAPNET_REFERENCE``, detections simulated. The
poses are off by 0.75 m sideways, 1.5 m along and 0.85 degrees (standard deviations), as in RTMap (arXiv 2507.00980):
every frame by itself, as RTMap's data have it (with and without ``mapfusion.correct_poses``), or the drive as a whole.
Printed are precision, recall and F1 of the merged map at 1.0 m, and what remains of the errors of the poses, for 1, 2,
3, 5 and 10 drives.

No drive tells where all of them together lie. So the last columns are those of the map, and of the poses, once the
motion that all drives have in common, known here from their true poses, is taken out.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import asdict, astuple, dataclass, replace
from pathlib import Path

import numpy as np
import orjson
import shapely

from mapfusion import FrameMap, GlobalMap, MapIntegrator, RegionOfInterest, correct_poses, merge_maps
from mapfusion.arrays import Float
from mapfusion.geometry import transform_points
from predmapnet.datasets.ground_truth.whole_map import truth_map
from predmapnet.demo_world.catalogue import trajectory, vector_map
from predmapnet.demo_world.truth import truth_from_vector_map
from predmapnet.evaluation.global_map import THRESHOLDS, global_map_quality, seen_area
from predmapnet.files import check_output, write_file
from tests.mapfusion.argoverse import LOGS, log_map, log_poses
from tests.mapfusion.pose_noise import off_by_drive, off_by_frame, remaining_errors
from tests.mapfusion.simulation import ROI, pose, simulate

Noise = Callable[[Sequence[Float], np.random.Generator], list[Float]]
CONDITIONS: dict[str, tuple[Noise | None, bool]] = {
    "right": (None, False),
    "each frame off": (off_by_frame, False),
    "  corrected": (off_by_frame, True),
    "each drive off": (off_by_drive, False),
}
"""What is wrong with the poses, and whether the frames of each drive are corrected before they are mapped."""
DRIVES = (1, 2, 3, 5, 10)
DEVELOPMENT, HELD_OUT = (0, 1), (200, 201)
"""Seeds: the merge was made with the first, nobody has looked at the others while choosing."""
TOWNS = {DEVELOPMENT: ("scene-0001", "scene-0002"), HELD_OUT: ("scene-0101", "scene-0102")}
AROUND = RegionOfInterest(90.0, 60.0)
"""Truth reaches farther than any drive looks."""


@dataclass(frozen=True, eq=False)
class Place:
    """A road with its true map and the poses of a drive along it."""

    name: str
    truth: GlobalMap
    poses: tuple[Float, ...]

    @property
    def seen(self) -> shapely.Geometry:
        """The ground in which truth counts."""
        return seen_area(self.poses, ROI)


@dataclass(frozen=True)
class MappedDrive:
    """One drive: its map, the poses of its frames by which it was made, and the true ones."""

    map: GlobalMap
    poses: tuple[Float, ...]
    true_poses: tuple[Float, ...]


@dataclass(frozen=True)
class Remains:
    """Figures of one merged map; errors of poses as root mean squares: metres, metres, degrees."""

    precision: float
    recall: float
    f1: float
    sideways: float
    along: float
    turn: float
    common_f1: float
    common_sideways: float
    common_along: float
    common_turn: float


def town(name: str) -> Place:
    """Return a town of the demo world and the drive through it."""
    drive = trajectory(name)
    truth = truth_from_vector_map(vector_map(name))
    frames = list(zip(drive.timestamps.tolist(), drive.ego_to_global, strict=True))
    return Place(name, truth_map(truth, frames, AROUND), tuple(_flat(at) for at in drive.ego_to_global))


def log(folder: Path) -> Place:
    """Return an Argoverse 2 log."""
    return Place(f"log {folder.name[:8]}", log_map(folder), tuple(log_poses(folder)))


def _flat(at: Float) -> Float:
    return pose(at[0, 3], at[1, 3], float(np.arctan2(at[1, 0], at[0, 0])))


def detections(place: Place, seed: int, number: int) -> tuple[FrameMap, ...]:
    """Drive along a place, a little beside and ahead of the first drive, with other errors of the detector."""
    rng = np.random.default_rng([seed, number])
    step = np.linalg.norm(np.diff([at[:2, 3] for at in place.poses], axis=0), axis=1).mean()
    beside = pose(rng.uniform(0.0, step), rng.normal(0.0, 0.4), 0.0)
    return simulate(place.truth, [at @ beside for at in place.poses], rng).frames


def mapped(frames: Sequence[FrameMap], noise: Noise | None, rng: np.random.Generator, correct: bool) -> MappedDrive:
    """Map one drive by poses that are off, or by what correction makes of them."""
    true = tuple(frame.ego_to_global for frame in frames)
    poses = true if noise is None else noise(true, rng)
    placed = [replace(frame, ego_to_global=at) for frame, at in zip(frames, poses, strict=True)]
    placed = correct_poses(placed) if correct else placed
    integrator = MapIntegrator()
    for frame in placed:
        integrator.add(frame)
    return MappedDrive(integrator.map(), tuple(frame.ego_to_global for frame in placed), true)


def merged(place: Place, drives: Sequence[MappedDrive]) -> Remains:
    """Merge drives and measure the map, and the poses as the merge has corrected them."""
    whole, report = merge_maps([drive.map for drive in drives])
    status = {entry.name: entry for entry in report.maps}
    own: list[Float] = []
    for number, drive in enumerate(drives):
        correction = status[f"map {number}"].correction
        x, y = correction.apply(np.zeros((1, 2)))[0]
        motion = pose(x, y, correction.turn)
        own.extend(motion @ at for at in drive.poses)
    true = [at for drive in drives for at in drive.true_poses]
    common = _common_motion(own, true)
    straight = whole.moved(lambda points: transform_points(common, points))
    precision, recall, f1 = _quality(whole, place)
    return Remains(
        precision, recall, f1, *remaining_errors(own, true), _quality(straight, place)[2],
        *remaining_errors([common @ at for at in own], true),
    )  # fmt: skip


def _quality(found: GlobalMap, place: Place) -> tuple[float, float, float]:
    at = THRESHOLDS.index(1.0)
    whole = global_map_quality(found, place.truth, place.seen).overall
    return float(whole.precision[at]), float(whole.recall[at]), float(whole.f1[at])


def _common_motion(own: Sequence[Float], true: Sequence[Float]) -> Float:
    """Return the rigid motion (4, 4) that puts poses on the true ones best (Umeyama, without scale)."""
    first, second = (np.array([at[:2, 3] for at in poses]) for poses in (own, true))
    left, right = first - first.mean(axis=0), second - second.mean(axis=0)
    sine, cosine = (left[:, 0] * right[:, 1] - left[:, 1] * right[:, 0]).sum(), (left * right).sum()
    motion = pose(0.0, 0.0, float(np.arctan2(sine, cosine)))
    motion[:2, 3] = second.mean(axis=0) - motion[:2, :2] @ first.mean(axis=0)
    return motion


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the figures of each place and seed")
    parser.add_argument("--development", action="store_true", help="towns and seeds with which the merge was made")
    parser.add_argument("--drives", type=int, nargs="+", default=DRIVES)
    options = parser.parse_args()
    if options.json is not None:
        check_output(options.json)
    seeds = DEVELOPMENT if options.development else HELD_OUT
    places = [town(name) for name in TOWNS[seeds]]
    places += [log(path.parent) for path in sorted(LOGS.glob("*/city_SE3_egovehicle.feather"))]
    print(f"{', '.join(place.name for place in places)}; seeds {seeds}; map at 1.0 m; errors of poses that remain")
    print(f"{'poses':16}{'drives':>7}{'P':>7}{'R':>7}{'F1':>7}{'sideways':>10}{'along':>8}{'turn':>7}", end="")
    print(f"{'  without the common motion:':28}{'F1':>7}{'sideways':>10}{'along':>8}{'turn':>7}")
    rows = []
    frames = {
        (place, seed, number): detections(place, seed, number)
        for place in places
        for seed in seeds
        for number in range(max(options.drives))
    }
    for name, (noise, correct) in CONDITIONS.items():
        found: dict[int, list[Remains]] = {count: [] for count in options.drives}
        for where, place in enumerate(places):
            for seed in seeds:
                drives = [
                    mapped(frames[place, seed, number], noise, np.random.default_rng([seed, number, 1, where]), correct)
                    for number in range(max(options.drives))
                ]
                for count in options.drives:
                    found[count].append(merged(place, drives[:count]))
                    row = {"poses": name.strip(), "place": place.name, "seed": seed, "drives": count}
                    rows.append(row | asdict(found[count][-1]))
        for count in options.drives:
            _print_row(name, count, found[count])
    if options.json is not None:
        with write_file(options.json) as path:
            path.write_bytes(orjson.dumps(rows, option=orjson.OPT_INDENT_2))


def _print_row(poses: str, drives: int, found: Sequence[Remains]) -> None:
    p, r, f1, *errors, common_f1, sideways, along, turn = np.mean([astuple(one) for one in found], axis=0)
    print(f"{poses:16}{drives:7d}{p:7.3f}{r:7.3f}{f1:7.3f}", end="")
    print("{:8.2f} m{:6.2f} m{:6.2f}°".format(*errors), end="")
    print(f"{'':28}{common_f1:7.3f}{sideways:8.2f} m{along:6.2f} m{turn:6.2f}°", flush=True)


if __name__ == "__main__":
    main()
