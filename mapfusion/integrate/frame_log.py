"""Log of the frames that were taken in, to notice repeated ones and poses that jump."""

from __future__ import annotations

import math
from bisect import bisect_left
from dataclasses import dataclass, field

from mapfusion.arrays import Float

STANDSTILL = 3.0
"""Positions this close never count as a jump, metres."""

JUDGES = 3
"""Number of frames before and after by which a pose is judged."""


@dataclass
class DriveLog:
    """Frames of one drive in the order of time, nanoseconds: positions of the car, metres, and whether believed."""

    number: int
    times: list[int] = field(default_factory=list)
    positions: list[tuple[float, float]] = field(default_factory=list)
    believed: list[bool] = field(default_factory=list)


class FrameLog:
    """Frames of all drives, by name of the drive."""

    def __init__(self) -> None:
        self.logs: dict[str, DriveLog] = {}

    def drive(self, log: str) -> DriveLog:
        """Return the frames of a drive; drives are numbered as they appear."""
        if log not in self.logs:
            self.logs[log] = DriveLog(len(self.logs))
        return self.logs[log]

    def enter(self, log: str, timestamp: int, position: Float, max_speed: float) -> str | None:
        """Note a frame of a drive; returns what is wrong with it (it repeats one, or cannot be at that place), or None.

        The frames around it in time vote, believed ones with two votes: those between which and here a car could
        have driven (at ``max_speed``, m/s) against the others. So no frame is beyond doubt. If the first pose of a
        log is the wrong one, or if a log goes on elsewhere for good, two frames are refused and the rest is believed.
        """
        drive = self.drive(log)
        place = bisect_left(drive.times, timestamp)
        if place < len(drive.times) and drive.times[place] == timestamp:
            return "frame repeated"
        x, y = float(position[0]), float(position[1])
        votes = 0
        for i in range(max(place - JUDGES, 0), min(place + JUDGES, len(drive.times))):
            distance = math.hypot(x - drive.positions[i][0], y - drive.positions[i][1])
            near = distance <= STANDSTILL + max_speed * abs(timestamp - drive.times[i]) * 1e-9
            votes += (1 if near else -1) * (2 if drive.believed[i] else 1)
        drive.times.insert(place, int(timestamp))
        drive.positions.insert(place, (x, y))
        drive.believed.insert(place, votes >= 0)
        return None if votes >= 0 else "pose jumps"
