"""Check of a log of one's own: calibration, images and poses by themselves and against each other."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from mapfusion.arrays import Float, Integer
from mapfusion.elements import RegionOfInterest
from mapfusion.geometry import inverse_pose
from predmapnet.datasets.images import read_camera_image
from predmapnet.datasets.own_logs.image_motion import ImageMotion
from predmapnet.datasets.own_logs.scene import LATEST, LogScene
from predmapnet.datasets.own_logs.timed_poses import rows_apart
from predmapnet.datasets.plausibility import MOVING, drives_backwards
from predmapnet.errors import UserError
from predmapnet.scenes import Camera, Rig

HEIGHTS = (0.2, 5.0)
"""Plausible heights of cameras above the road, metres."""
STEEPEST_PITCH = 60.0
"""A camera that looks down by more sees its own car, degrees."""
UPRIGHT = 0.7
"""Cosine of the steepest roll."""
FARTHEST = 12.0
"""Plausible distance of a camera from the ego origin, metres."""
FIELDS = (10.0, 150.0)
"""Plausible horizontal fields of view, degrees."""
FASTEST = 80.0
"""Plausible speed of a car from one pose to the next, m/s."""
HARDLY = 1.0
"""A car that goes less far did not drive, metres."""
ENOUGH = 100
"""Points that must be followed through images before they tell anything."""
FITTING, MISFITTING = 0.75, 0.5
"""Share of points that fit a right calibration at least, and below which it is wrong."""


MUCH_BETTER = 0.2
"""By how much more points must fit for another explanation to be believed."""
CLOCK_ERRORS = (-1.0, -0.5, -0.2, -0.1, 0.1, 0.2, 0.5, 1.0)
"""Differences of clocks that are tried, seconds."""


@dataclass
class LogCheck:
    """Result of a check.

    Attributes:
        problems: what is wrong; the map would be, too.
        notes: what one should know.
    """

    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def check_log(folder: Path, rate: float) -> tuple[LogScene | None, LogCheck]:
    """Check a log; returns it, opened, or None where its files cannot be read."""
    check = LogCheck()
    try:
        log = LogScene(folder, rate)
    except UserError as error:
        check.problems.append(str(error))
        return None, check
    check.problems += _rig_problems(log.rig)
    for first, second in combinations(log.rig, 2):
        if np.allclose(first.camera_to_ego, second.camera_to_ego, atol=1e-6):
            check.problems.append(f"{first.name} and {second.name} have the same camera_to_ego")
    _check_images(log, check)
    _check_poses(log, check)
    if not check.problems:
        _check_motion(log, check)
    return log, check


def _rig_problems(rig: Rig) -> list[str]:
    found = [problem for camera in rig for problem in _mounting_problems(camera)]
    inverted = [replace(camera, camera_to_ego=inverse_pose(camera.camera_to_ego)) for camera in rig]
    if len(found) >= len(rig) and not any(problem for camera in inverted for problem in _mounting_problems(camera)):
        return ["camera_to_ego seems to be the way from the car to the camera: inverted, all cameras sit well", *found]
    return found


def _mounting_problems(camera: Camera) -> Iterator[str]:
    name, pose = camera.name, camera.camera_to_ego
    height, away = float(pose[2, 3]) - camera.ground_height, float(np.linalg.norm(pose[:2, 3]))
    up, pitch = -float(pose[2, 1]), float(np.degrees(np.arcsin(np.clip(-pose[2, 2], -1, 1))))
    width = float(np.degrees(camera.sector.field_of_view))
    if not FIELDS[0] <= width <= FIELDS[1]:
        yield f"{name} would see {width:.0f} degrees from left to right: are fx and the width of the same image?"
    if not HEIGHTS[0] <= height <= HEIGHTS[1] or away > FARTHEST:
        millimetres = ": translation_m seems to be in millimetres" if height > 100.0 or away > 100.0 else ""
        yield f"{name} would be {height:.2f} m above the road and {away:.1f} m from the ego origin{millimetres}"
    elif pitch > STEEPEST_PITCH:
        yield f"{name} looks into the ground: {pitch:.0f} degrees down"
    elif up < 0.0:
        yield f"{name} stands on its head by its rotation: y of the camera must point down, and points up"
    elif up < UPRIGHT and abs(pitch) < 45.0:
        yield f"{name} lies on its side by its rotation; images that are stored turned must be turned back"
    elif not _sees_road(camera):
        yield f"{name} sees nothing of the road within 30 m: it looks {-pitch:.0f} degrees up"


def _sees_road(camera: Camera) -> bool:
    """Whether any point of the road in the region lies in a camera's image."""
    half = RegionOfInterest().size / 2
    x, y = np.meshgrid(np.arange(-half[0], half[0] + 1), np.arange(-half[1], half[1] + 1))
    points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, camera.ground_height)])
    rays = (points - camera.camera_to_ego[:3, 3]) @ camera.camera_to_ego[:3, :3] @ camera.intrinsics.T
    pixels = rays[:, :2] / np.maximum(rays[:, 2:], 1e-6)
    inside = (pixels > 0).all(axis=1) & (pixels < [camera.width, camera.height]).all(axis=1)
    return bool((inside & (rays[:, 2] > 0.1)).any())


def _check_images(log: LogScene, check: LogCheck) -> None:
    unknown = {path.name for path in (log.folder / "images").iterdir() if path.is_dir()} - set(log.images)
    if unknown:
        check.notes.append(f"images of {', '.join(sorted(unknown))} are left out: calibration.json does not name them")
    for camera in log.rig:
        times, files = log.images[camera.name]
        if not len(times):
            check.problems.append(f"{camera.name} has no images (images/{camera.name}/<nanoseconds>.jpg)")
            continue
        for file in dict.fromkeys([files[0], files[len(files) // 2], files[-1]]):
            try:
                read_camera_image(file, camera)
            except UserError as error:
                check.problems.append(str(error))
                break
        check.notes.append(f"{camera.name}: {_rate(times)}" + _without_pose(log, times))
    frames = [log.frame(index) for index in range(len(log))]
    for camera in log.rig:
        missing = [frame.index for frame in frames if camera.name not in frame.images]
        if missing and len(log.images[camera.name][0]):
            text = (
                f"{camera.name} has no image within {LATEST / 1e9:g} s of {len(missing)} of {len(frames)} frames (the "
                f"first is frame {missing[0]})"
            )
            (check.problems if 2 * len(missing) > len(frames) else check.notes).append(text)


def _rate(times: Integer) -> str:
    if len(times) < 2:
        return f"{len(times)} image"
    steps = np.diff(times) / 1e9
    period = float(np.median(steps))
    lost = int(np.maximum(np.round(steps / period) - 1, 0).sum())
    text = f"{len(times)} images, {1 / period:.1f} Hz"
    return text + (f", {lost} lost (the longest gap is {steps.max():.2f} s)" if lost else "")


def _without_pose(log: LogScene, times: Integer) -> str:
    count = int((~log.poses.cover(times)).sum())
    return f", {count} without a pose" if count else ""


def _check_poses(log: LogScene, check: LogCheck) -> None:
    times, poses = log.poses.timestamps, log.poses.ego_to_global
    if len(times) < 2:
        check.problems.append("there is only one pose: nobody knows where the car drove")
        return
    steps, seconds = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1), np.diff(times) / 1e9
    way, speeds = float(steps.sum()), steps / seconds
    check.notes.append(f"poses: {len(times)}, {1 / float(np.median(seconds)):.1f} Hz, {way:.1f} m")
    if float(np.median(speeds)) > FASTEST:
        check.problems.append(f"the car would drive {float(np.median(speeds)):.0f} m/s: are the poses in millimetres?")
    elif (speeds > FASTEST).any():
        row = int(np.argmax(speeds))
        check.problems.append(f"the poses jump by {steps[row]:.1f} m in {seconds[row]:.2f} s at {times[row]}")
    if way < HARDLY and seconds.sum() > 5.0:
        check.notes.append(f"the car goes {way:.2f} m in {seconds.sum():.0f} s. If it did drive, what unit is that?")
    _check_headings(poses, check)


def _check_headings(poses: Float, check: LogCheck) -> None:
    chosen = poses[rows_apart(poses[:, :3, 3], 2 * MOVING)]
    if drives_backwards(chosen[:, :3, :3], chosen[:, :2, 3]):
        check.problems.append("by its poses the car drives sideways or backwards throughout: x must point ahead")
        return
    moved = np.diff(chosen[:, :2, 3], axis=0)
    nose = chosen[:-1, :2, 0] + chosen[1:, :2, 0]
    along = (nose * moved).sum(axis=1) / np.maximum(np.linalg.norm(nose, axis=1) * np.linalg.norm(moved, axis=1), 1e-9)
    share = float((along < 0.5).mean()) if len(along) > 10 else 0.0
    if share > 0.3:
        check.problems.append(
            f"in {100 * share:.0f} % of its way the car drives sideways or backwards: are headings in radians?"
        )


def _check_motion(log: LogScene, check: LogCheck) -> None:
    """Compare the motion in the images with calibration and poses."""
    motions = []
    for camera in log.rig:
        motion = ImageMotion(log, camera)
        if motion.points < ENOUGH:
            check.notes.append(f"{camera.name}: too little moves in its images to check how it is mounted")
            continue
        share, best = motion.fitting(), motion.explanation()
        text = f"{camera.name}: {100 * share:.0f} % of {motion.points} points move as calibration and poses say"
        if best.wrong and best.share > share + MUCH_BETTER:
            check.problems.append(f"{text}, but {100 * best.share:.0f} % would if {best.wrong}")
            continue
        motions.append(motion)
        text += ": look at its picture" if share < FITTING else ""
        (check.problems if share < MISFITTING else check.notes).append(text)
    if motions and _mean_fitting(motions) < FITTING:
        best_late = max(CLOCK_ERRORS, key=lambda late: _mean_fitting(motions, late))
        if _mean_fitting(motions, best_late) > _mean_fitting(motions) + MUCH_BETTER / 2:
            check.problems.append(
                f"the clocks of images and poses seem to differ: {100 * _mean_fitting(motions, best_late):.0f} % of "
                f"the points would fit, instead of {100 * _mean_fitting(motions):.0f} %, if {best_late:g} s were added "
                "to the times of the images"
            )


def _mean_fitting(motions: list[ImageMotion], late: float = 0.0) -> float:
    return float(np.mean([motion.fitting(round(late * 1e9)) for motion in motions]))
