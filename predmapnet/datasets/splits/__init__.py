"""Lists of scene names per split, as plain text files with their source in the first line."""

from __future__ import annotations

from functools import cache
from importlib.resources import files

from predmapnet.errors import UserError

SPLITS = ("train", "val", "test")


def check_split(split: str | None) -> None:
    """Raise UserError for a split that no data set has; None means all."""
    if split is not None and split not in SPLITS:
        raise UserError(f"There is no split '{split}'. There are: {', '.join(SPLITS)}.")


@cache
def split_names(name: str) -> tuple[str, ...]:
    """Return the scene or log names of a split list, for example ``nuscenes_old_val``."""
    text = (files(__package__) / f"{name}.txt").read_text(encoding="utf-8")
    return tuple(line for line in text.splitlines() if line and not line.startswith("#"))
