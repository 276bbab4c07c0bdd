"""A log of one's own that was made from a recording: what is in it, and whether it can be read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from predmapnet.datasets.own_logs.calibration import CALIBRATION, read_calibration
from predmapnet.datasets.own_logs.scene import LogScene
from predmapnet.datasets.own_logs.timed_poses import TimedPoses
from predmapnet.errors import UserError


@dataclass(frozen=True)
class MadeLog:
    """Summary of what was written.

    Attributes:
        cameras: where the images of each camera come from.
        images: how many there are of each camera.
        poses: what says where the car was, and how often.
        notes: what was guessed, left out or lost.
        written: the folder.
    """

    cameras: dict[str, str]
    images: dict[str, int]
    poses: str
    notes: list[str]
    written: Path


def check_made_log(draft: Path, out: Path, source: Path) -> None:
    """Raise UserError, naming ``source``, if the log in ``draft``, which is to become ``out``, cannot be opened."""
    try:
        read_calibration(draft / CALIBRATION)
        LogScene(draft)
    except UserError as error:
        raise UserError(f"{source}: {str(error).replace(str(draft), str(out))}") from None


def count_and_rate(poses: TimedPoses) -> str:
    """Return how many poses there are, and how often, for people."""
    seconds = (poses.timestamps[-1] - poses.timestamps[0]) / 1e9
    count = len(poses.timestamps)
    return f"{count:,} poses, {(count - 1) / seconds:.0f} Hz" if count > 1 else "one pose"
