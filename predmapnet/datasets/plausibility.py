"""Plausibility of what a log says of its car: unit of time, order of quaternions, cameras that look at the road.

Wrong units and orders raise no error by themselves: they make a car tilt, drive sideways or fly, and maps of nothing.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mapfusion.arrays import Bool, Float, Integer
from predmapnet.datasets.fields import numbers

NANOSECONDS = {"seconds": 1_000_000_000, "milliseconds": 1_000_000, "microseconds": 1_000, "nanoseconds": 1}
"""Nanoseconds of each unit."""
FASTEST = 100.0
"""Highest plausible median speed of a car, m/s."""
SHORTEST_STEP = 9e5
"""Shortest plausible median step between frames, nanoseconds."""
LONGEST_STEP = 3.6e12
"""Longest plausible median step between frames, nanoseconds."""
ERAS = (1e17, 5e18)
"""Times of the clock, nanoseconds since 1970, that are told by their size: 1973 to 2128."""
MOVING = 0.3
"""Shorter steps do not tell where a car drives, metres."""
STEEPEST = 30.0
"""No road tilts a car by more, degrees."""
ROLLED = 0.3
"""A level camera has the sky on top of its images if the cosine of its roll is above this."""
SIDEWAYS = 60.0
"""A car that drives at more than this to its x axis drives sideways or backwards, degrees."""


def judged_unit(times: Integer, positions: Float, stated: str = "nanoseconds") -> str:
    """Return the unit that time stamps ``(n,)`` are in, judged by their size and by the speed of the car.

    That is the ``stated`` one where it is plausible, or where no other unit is. Positions are ``(n, 2)``, metres.
    """
    if len(times) < 2:
        return stated
    median_step = float(np.median(np.diff(times)))
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    metres = float(np.median(steps))
    if median_step <= 0.0 or not np.isfinite(metres):
        return stated

    def plausible(unit: str) -> bool:
        step = median_step * NANOSECONDS[unit]
        return step >= SHORTEST_STEP and metres <= FASTEST * step / 1e9

    def of_our_days(unit: str) -> bool:
        # A clock that begins with the drive has a second in nanoseconds where others have years in seconds.
        moderate = median_step * NANOSECONDS[unit] <= LONGEST_STEP
        return moderate and ERAS[0] <= float(times[0]) * NANOSECONDS[unit] <= ERAS[1]

    by_size = [unit for unit in NANOSECONDS if of_our_days(unit)]
    others = [unit for unit in (*by_size, *reversed(NANOSECONDS)) if plausible(unit)]
    if stated in by_size or (not by_size and plausible(stated)) or not others:
        return stated
    return others[0]


def trajectory_problem(rotations: Float, positions: Float, reordered: Float | None = None) -> str | None:
    """Say what is impossible about how a car lies and drives; None if nothing is.

    Args:
        rotations: ``(n, 3, 3)`` of ``ego_to_global``, in the order of time.
        positions: ``(n, 2)`` metres.
        reordered: the rotations that the same quaternions mean if they are x, y, z, w.
    """
    if len(rotations) < 2:
        return None
    odd, judged, tilted = _oddness(rotations, positions)
    if reordered is not None and judged.sum() >= 2 and odd[judged].mean() > 0.8:
        other, other_judged, _ = _oddness(reordered, positions)
        if not other[other_judged].any() or other[other_judged].mean() < 0.2:
            return (
                f"{_described(tilted, odd)}. Its quaternions seem to be in the order x, y, z, w, which would fit; "
                "w, x, y, z is expected"
            )
    if len(tilted) and tilted.mean() > 0.5:
        return f"{_described(tilted, odd)}: its rotations are not those of a car with x forward, y left and z up"
    return None


def drives_backwards(rotations: Float, positions: Float) -> bool:
    """Whether a car drives sideways or backwards throughout; arguments as of :func:`trajectory_problem`."""
    if len(rotations) < 2:
        return False
    odd, judged, tilted = _oddness(rotations, positions)
    moving = judged & ~tilted
    return bool(moving.sum() >= 3 and odd[moving].mean() > 0.9)


def camera_problem(rotations: Float, reordered: Float) -> str | None:
    """Say whether cameras look at the road only if their quaternions are in another order, or not at all, or None.

    ``reordered`` are the ``camera_to_ego`` rotations that the same quaternions mean if they are x, y, z, w.
    """
    if _upright(rotations).mean() <= 0.5 and _upright(reordered).all():
        return (
            "most cameras look at the sky, at the ground or stand on their heads. The quaternions seem to be in the "
            "order x, y, z, w, which would fit; w, x, y, z is expected"
        )
    level = np.abs(rotations[:, 2, 2]) < 0.71
    if len(level) > 2 and (level & (-rotations[:, 2, 1] < ROLLED)).mean() > 0.5:
        return (
            "most cameras lie on their sides or stand on their heads. Are their rotations inverted? The way from the "
            "camera (x right, y down, z ahead) to the car is expected"
        )
    return None


def rotations_of(quaternions: Float) -> Float:
    """Return rotation matrices ``(n, 3, 3)`` of unit quaternions ``(n, 4)``, w, x, y, z."""
    w, x, y, z = quaternions.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows, dtype=np.float64), -1, 0)


def reordered_rotations(quaternions: Float) -> Float:
    """Return the rotations that quaternions ``(n, 4)`` mean if they are x, y, z, w instead of w, x, y, z."""
    return rotations_of(quaternions[:, [3, 0, 1, 2]])


def unit_quaternions(values: Sequence[object]) -> Float:
    """Return ``(n, 4)`` of those values that are unit quaternions; the others have readers of their own."""
    found = []
    for value in values:
        try:
            quaternion = numbers(value)
        except ValueError:
            continue
        if quaternion.shape == (4,) and abs(float(np.linalg.norm(quaternion)) - 1.0) < 1e-3:
            found.append(quaternion)
    return np.array(found).reshape(-1, 4)


def _oddness(rotations: Float, positions: Float) -> tuple[Bool, Bool, Bool]:
    """Return per frame whether the car is tilted or drives against its nose, whether that can be told, and tilted."""
    tilted = rotations[:, 2, 2] < np.cos(np.radians(STEEPEST))
    steps = np.diff(positions, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    nose = rotations[:-1, :2, 0] + rotations[1:, :2, 0]
    along = (nose * steps).sum(axis=1)
    against = along < np.cos(np.radians(SIDEWAYS)) * lengths * np.maximum(np.linalg.norm(nose, axis=1), 1e-9)
    moving = np.append(lengths > MOVING, False)
    odd = tilted | (moving & np.append(against, False))
    return odd, moving | tilted, tilted


def _upright(cameras: Float) -> Bool:
    """Whether cameras look at most 45 degrees up or down, and have the sky on top of their images."""
    return np.asarray((np.abs(cameras[:, 2, 2]) < 0.71) & (cameras[:, 2, 1] < 0.0))


def _described(tilted: Bool, odd: Bool) -> str:
    if tilted.mean() > 0.5:
        return (
            f"the car would be tilted by more than {STEEPEST:g} degrees in {int(tilted.sum())} of {len(tilted)} frames"
        )
    return f"the car would be tilted, or drive sideways or backwards, in {int(odd.sum())} of {len(odd)} frames"
