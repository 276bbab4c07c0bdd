"""Which frames were taken in, to notice repeated ones and poses that jump."""

from __future__ import annotations

import math
from bisect import bisect_left
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

STANDSTILL = 3.0
"""Positions this close never count as a jump, metres."""

NEIGHBOURS = 3
"""Frames before and after that a pose is judged by."""


@dataclass
class LogBook:
    """The frames of one log in the order of time: nanoseconds, metres, and whether each was believed."""

    number: int
    times: list[int] = field(default_factory=list)
    positions: list[tuple[float, float]] = field(default_factory=list)
    believed: list[bool] = field(default_factory=list)


class Journal:
    """What is known of the frames of each log."""

    def __init__(self) -> None:
        self.logs: dict[str, LogBook] = {}

    def book(self, log: str) -> LogBook:
        """Return what is known of a log; logs are numbered as they appear."""
        if log not in self.logs:
            self.logs[log] = LogBook(len(self.logs))
        return self.logs[log]

    def enter(self, log: str, timestamp: int, position: Float, max_speed: float) -> str | None:
        """Note a frame and say whether it repeats one, or whether the car can hardly have been there.

        The frames around it in time vote, believed ones with two votes: those between which and here a car could
        have driven against the others. So no frame is beyond doubt. If the first pose of a log is the wrong one, or
        if a log goes on at another place for good, two frames are refused and the rest is believed.

        Args:
            log: name of the drive.
            timestamp: nanoseconds.
            position: ``(2,)``, metres, global frame.
            max_speed: metres per second.

        Returns:
            What is wrong with the frame, or None.
        """
        book = self.book(log)
        place = bisect_left(book.times, timestamp)
        if place < len(book.times) and book.times[place] == timestamp:
            return "frame repeated"
        x, y = float(position[0]), float(position[1])
        votes = 0
        for i in range(max(place - NEIGHBOURS, 0), min(place + NEIGHBOURS, len(book.times))):
            distance = math.hypot(x - book.positions[i][0], y - book.positions[i][1])
            near = distance <= STANDSTILL + max_speed * abs(timestamp - book.times[i]) * 1e-9
            votes += (1 if near else -1) * (2 if book.believed[i] else 1)
        book.times.insert(place, int(timestamp))
        book.positions.insert(place, (x, y))
        book.believed.insert(place, votes >= 0)
        return None if votes >= 0 else "pose jumps"
