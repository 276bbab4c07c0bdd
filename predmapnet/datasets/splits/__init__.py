"""Lists of scene names per split, as plain text files with their source in the first line.

There are two ways to divide nuScenes and Argoverse 2. ``old`` is the data sets' own; its validation scenes often lie
on streets that are also in the training scenes. ``new`` is the geographically disjoint one of StreamMapNet, which has
no test split.
"""

from __future__ import annotations

from functools import cache
from importlib.resources import files

from predmapnet.errors import UserError

SPLITS = ("train", "val", "test")
SCHEMES = ("old", "new")


def check_split(split: str | None, scheme: str = "old") -> None:
    """Raise UserError for a split that no data set, or not this scheme, has; None means all."""
    if split is not None and split not in SPLITS:
        raise UserError(f"There is no split '{split}'. There are: {', '.join(SPLITS)}.")
    if scheme == "new" and split == "test":
        raise UserError("The new (geographically disjoint) split has train and val, but no test.")


def check_scheme(scheme: str) -> None:
    """Raise UserError for a split scheme that does not exist."""
    if scheme not in SCHEMES:
        raise UserError(
            f"There is no split scheme '{scheme}'. There are: old (the data set's own) and new (geographically "
            "disjoint, of StreamMapNet)."
        )


@cache
def split_names(name: str) -> tuple[str, ...]:
    """Return the scene or log names of a split list, for example ``nuscenes_old_val``."""
    text = (files(__package__) / f"{name}.txt").read_text(encoding="utf-8")
    return tuple(line for line in text.splitlines() if line and not line.startswith("#"))
