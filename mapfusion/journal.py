"""Which frames were taken in, to notice repeated ones and poses that jump."""

from __future__ import annotations

from bisect import bisect_left

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

STANDSTILL = 3.0
"""Positions this close never count as a jump, metres."""


class Journal:
    """Timestamps and positions of the frames of each log, in the order of time."""

    def __init__(self) -> None:
        self.logs: dict[str, tuple[list[int], list[tuple[float, float]]]] = {}

    def enter(self, log: str, timestamp: int, position: Float, max_speed: float) -> str | None:
        """Note a frame, unless it repeats one or no car could have come there from the frames around it in time.

        Args:
            log: name of the drive.
            timestamp: nanoseconds.
            position: ``(2,)``, metres, global frame.
            max_speed: metres per second.

        Returns:
            What is wrong with the frame, or None.
        """
        times, positions = self.logs.setdefault(log, ([], []))
        place = bisect_left(times, timestamp)
        if place < len(times) and times[place] == timestamp:
            return "frame repeated"
        around = range(max(place - 1, 0), min(place + 1, len(times)))
        jumps = [
            float(np.hypot(position[0] - positions[i][0], position[1] - positions[i][1]))
            > STANDSTILL + max_speed * abs(timestamp - times[i]) * 1e-9
            for i in around
        ]
        if any(jumps):
            return "pose jumps"
        times.insert(place, int(timestamp))
        positions.insert(place, (float(position[0]), float(position[1])))
        return None
