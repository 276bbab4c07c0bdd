"""Protocols of the stability metric, apart from the metric so that the command line need not load it."""

from __future__ import annotations

from enum import StrEnum


class Protocol(StrEnum):
    """Protocols of the stability metric.

    ``ANCHORED`` has instances of the ground truth, all of them, each with its own poses. ``PUBLISHED`` is the
    same with the toolbox's defect, ``PAIRED`` the toolbox's protocol without ground truth.
    """

    ANCHORED = "anchored"
    PUBLISHED = "published"
    PAIRED = "paired"
