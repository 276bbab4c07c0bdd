"""The real street among the fixtures: real photographs, and lines traced from labelled lidar."""

from __future__ import annotations

from pathlib import Path

from predmapnet.datasets.own_logs.scene import LogScene

EVERY_IMAGE = 1000.0
"""A rate that takes every image of the reference camera, frames a second."""


def open_street(folder: Path) -> LogScene:
    """Open the street as a scene with its truth, all its frames."""
    return LogScene(folder, EVERY_IMAGE)
