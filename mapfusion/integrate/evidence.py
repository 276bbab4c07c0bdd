"""Evidence for a fused element as a whole: when it was seen, how often, and by which tracks."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeAlias

Track: TypeAlias = tuple[int, int]
"""Track of a drive: number of the drive, id within it; the ids of two drives may be equal."""


@dataclass
class Evidence:
    """Evidence for one fused element.

    Attributes:
        first_seen, last_seen: nanoseconds.
        observations: number of frames that saw it.
        tracks: number of frames in which each track was fused into it.
        beside: number of frames that showed another element, by its id, beside this one.
    """

    first_seen: int
    last_seen: int
    observations: int = 1
    tracks: dict[Track, int] = field(default_factory=dict)
    beside: dict[int, int] = field(default_factory=dict)

    def sighted(self, track: Track, timestamp: int, again: bool = False) -> None:
        """Count one frame of a track; ``again`` where another observation of the same frame was counted."""
        self.first_seen = min(self.first_seen, timestamp)
        self.last_seen = max(self.last_seen, timestamp)
        self.observations += not again
        self.tracks[track] = self.tracks.get(track, 0) + 1

    def absorb(self, other: Evidence) -> None:
        """Add the evidence for an element that turned out to be this one."""
        self.first_seen = min(self.first_seen, other.first_seen)
        self.last_seen = max(self.last_seen, other.last_seen)
        self.observations += other.observations
        for track, count in other.tracks.items():
            self.tracks[track] = self.tracks.get(track, 0) + count
        for element, count in other.beside.items():
            self.beside[element] = self.beside.get(element, 0) + count
