"""Checks of a whole log, which a reader makes when it opens one: its clock, its drive and its cameras."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mapfusion.arrays import Float, Integer
from predmapnet.datasets.fields import numbers
from predmapnet.datasets.plausibility import (
    FASTEST,
    NANOSECONDS,
    camera_problem,
    judged_unit,
    reordered_rotations,
    rotations_of,
    trajectory_problem,
    unit_quaternions,
)
from predmapnet.errors import UserError


def check_cameras(stored: Sequence[object], where: str) -> None:
    """Raise UserError for cameras that look at the road only if their quaternions are x, y, z, w.

    Args:
        stored: quaternions of the cameras, w, x, y, z; those that are none are told of where they are read.
        where: file and log, for the message.
    """
    quaternions = unit_quaternions(stored)
    if len(quaternions):
        problem = camera_problem(rotations_of(quaternions), reordered_rotations(quaternions))
        if problem is not None:
            raise UserError(f"{where}: {problem}.")


def check_clock(times: Integer, positions: Float, stated: str, where: str) -> None:
    """Raise UserError for time stamps or positions that can only be of another unit than the data set's.

    Args:
        times: ``(n,) int64``, ascending, in the unit ``stated``.
        positions: ``(n, 2)`` metres, of the car.
        stated: unit of the data set.
        where: file and log, for the message.
    """
    unit = judged_unit(times, positions, stated)
    if unit != stated:
        raise UserError(f"{where}: the time stamps seem to be {unit}; {stated} are expected.")
    if len(times) and float(np.abs(times).max()) * NANOSECONDS[stated] >= 2.0**63:
        raise UserError(f"{where}: the time {times[0]} is too large for {stated}.")
    seconds = np.diff(times) * (NANOSECONDS[stated] / 1e9)
    metres = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    speed = float(np.median(metres / np.maximum(seconds, 1e-9))) if len(times) > 1 else 0.0
    if speed > FASTEST:
        raise UserError(
            f"{where}: the car would drive {speed:,.0f} m/s. Are the poses in millimetres? Metres are expected."
        )


def check_drive(quaternions: Float, positions: Float, where: str) -> None:
    """Raise UserError for poses that no car has.

    Args:
        quaternions: ``(n, 4)`` of unit length, w, x, y, z, in the order of time.
        positions: ``(n, 2)`` metres.
        where: file and log, for the message.
    """
    problem = trajectory_problem(rotations_of(quaternions), positions, reordered_rotations(quaternions))
    if problem is not None:
        raise UserError(f"{where}: {problem}.")


def usable_poses(stored: Sequence[tuple[object, object]]) -> tuple[list[int], Float, Float]:
    """Return which poses can be used, their quaternions and positions; others are told of where they are read.

    Args:
        stored: rotation and translation of each pose, as a file has them.

    Returns:
        Rows, ``(n, 4)`` unit quaternions and ``(n, 2)`` metres.
    """
    rows, quaternions, positions = [], [np.zeros((0, 4))], [np.zeros((0, 2))]
    for row, (rotation, translation) in enumerate(stored):
        quaternion = unit_quaternions([rotation])
        try:
            position = numbers(translation)
        except ValueError:
            continue
        if len(quaternion) and position.shape == (3,) and np.isfinite(position).all():
            rows.append(row)
            quaternions.append(quaternion)
            positions.append(position[None, :2])
    return rows, np.concatenate(quaternions), np.concatenate(positions)
