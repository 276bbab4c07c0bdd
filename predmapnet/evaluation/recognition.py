"""Recognition of results: the region of their elements, the split of their scenes, and warnings of both."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from mapfusion.arrays import Float
from mapfusion.elements import RegionOfInterest
from predmapnet.errors import UserError
from predmapnet.scenes import STANDARD_REGION, SceneInfo

STANDARD, WIDE = STANDARD_REGION, RegionOfInterest(100.0, 50.0)
"""Regions of the benchmarks."""
TELLING = 3
"""Elements that a frame must hold to be asked for its region."""
OVERSHOOT = 1.0
"""Metres by which an element may leave its region."""
FEW, MANY = 0.1, 0.2
"""Shares of vertices beyond a region: up to the first they are overshoots, from the second on it is another region."""

_OVERLAP = {
    "nuscenes": "more than 80 % of the validation and test frames of nuScenes' own splits",
    "argoverse2": "about 40 % of the validation and test frames of Argoverse 2's own splits",
}
"""As counted by Lilja et al., *Localization Is All You Evaluate* (CVPR 2024)."""


def region_of(path: Path, frames: Sequence[Sequence[Float]]) -> RegionOfInterest:
    """Recognise the region for which the elements of frames (``(k, 2)`` each, metres, ego frame) were made.

    Raises UserError where the axes are not x forward and y left, they fit neither region of the benchmarks, or some
    frames fit one and some the other.
    """
    polylines = [line for lines in frames for line in lines]
    if not polylines:
        return STANDARD
    away = np.abs(np.concatenate(polylines))
    across, along = _beyond(away[:, ::-1], STANDARD), _beyond(away, STANDARD)
    if across <= FEW and along >= MANY:
        raise UserError(
            f"{path}: the elements reach {np.quantile(away[:, 1], 0.99):.0f} m to the sides and "
            f"{np.quantile(away[:, 0], 0.99):.0f} m ahead. Their axes seem to be x right and y forward, but x forward "
            "and y left are needed: (x, y) becomes (y, -x)."
        )
    if along <= FEW:
        return STANDARD
    telling = [np.abs(np.concatenate(lines)) for lines in frames if len(lines) >= TELLING]
    narrow = sum(_beyond(frame, STANDARD) == 0.0 for frame in telling)
    if along >= MANY and _beyond(away, WIDE) <= FEW and narrow <= MANY * len(telling):
        return WIDE
    if narrow:
        raise UserError(
            f"{path}: {narrow} of {len(telling)} frames keep within 60 m x 30 m, the others do not. Are frames of two "
            "regions mixed? If not, say the region with --roi."
        )
    raise UserError(
        f"{path}: {100 * along:.0f} % of the vertices lie outside 60 m x 30 m and {100 * _beyond(away, WIDE):.0f} % "
        "outside 100 m x 50 m, so it cannot be told for which region they were made. Are frames of two regions mixed? "
        "If not, say it with --roi."
    )


def check_region(path: Path, polylines: Sequence[Float], roi: RegionOfInterest) -> None:
    """Raise UserError for a region that many vertices contradict; a wide one without anything far outside is fine."""
    share = _beyond(np.abs(np.concatenate(polylines)), roi) if polylines else 0.0
    if share >= MANY:
        raise UserError(
            f"{path}: {100 * share:.0f} % of the vertices lie outside {roi.length:g} m x {roi.width:g} m, so they "
            "were made for another region; leave out --roi to have it recognised."
        )


def frames_look_like(names: Iterable[str]) -> str | None:
    """Recognise the data set by the names of frames: sample tokens or time stamps; None if they are neither."""
    kinds = {_kind_of_name(name) for name in names}
    if len(kinds) > 1 and None not in kinds:
        return "a mixture of nuScenes and Argoverse 2"
    return kinds.pop() if len(kinds) == 1 else None


def looks_foreign(dataset: str, name: str) -> bool:
    """Whether a frame is named as in another public data set than ``dataset`` (``nuscenes`` or ``argoverse2``)."""
    own = {"nuscenes": "nuScenes", "argoverse2": "Argoverse 2"}
    return dataset in own and _kind_of_name(name) not in (None, own[dataset])


def split_of(infos: Sequence[SceneInfo], scenes: Sequence[str]) -> tuple[str, int]:
    """Recognise the split of the scenes that are measured; returns it, and how many scenes the data set has of it.

    Raises UserError for scenes of several splits.
    """
    of = {info.name: info.split for info in infos}
    measured = [of[name] for name in scenes]
    splits = sorted(set(measured))
    if len(splits) > 1:
        counts = " and ".join(f"{measured.count(split)} of {split}" for split in splits)
        raise UserError(
            f"These are scenes of several splits ({counts}); a figure over all of them would mix what was trained on "
            f"with what was not. Choose one: --split {' or --split '.join(splits)}."
        )
    return splits[0], sum(info.split == splits[0] for info in infos)


def warnings_of(dataset: str, scheme: str, split: str, measured: int, in_split: int) -> list[str]:
    """Return what a reader of the figures must know of the scenes.

    Of ``dataset`` (``nuscenes``, ``argoverse2`` or ``demo``), by the ``old`` or ``new`` scheme of splits, ``measured``
    scenes are, of as many as its split has here.
    """
    found = []
    if split == "train":
        found.append("these are scenes of the training split: the figures say nothing about new places")
    elif scheme == "old" and dataset in _OVERLAP:
        found.append(
            f"{_OVERLAP[dataset]} lie within 5 m of a training frame, so remembered places count as skill; "
            "--split-scheme new has disjoint splits"
        )
    if measured < in_split:
        found.append(f"{measured} of the {in_split} scenes of the split {split}: not comparable with all of them")
    return found


def _beyond(away: Float, roi: RegionOfInterest) -> float:
    return float((away > roi.size / 2 + OVERSHOOT).any(axis=1).mean())


def _kind_of_name(name: str) -> str | None:
    last = name.rsplit("_", 1)[-1]
    if last.isdigit() and 16 <= len(last) <= 19:
        return "Argoverse 2"
    return "nuScenes" if len(name) == 32 and set(name) <= set("0123456789abcdef") else None
