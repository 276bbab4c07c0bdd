"""Keep a scene's ground truth on disk, under a key made of everything that it depends on.

A key that leaves something out goes stale unseen: annotation caches that outlived a change of their region or split
have spoilt published figures. So the key covers the map's bytes, every pose, the region and this code's version.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mapfusion.elements import RegionOfInterest
from predmapnet.datasets.source import FrameTruth

Float = NDArray[np.float64]

EXTRACTION_VERSION = 1
"""Goes up with every change of the ground-truth code that can change a result."""


def cache_key(fingerprint: bytes, poses: Sequence[Float], roi: RegionOfInterest, dataset: str) -> str:
    """Name of a scene's ground truth.

    Args:
        fingerprint: digest of the map file as it lies on disk.
        poses: of each frame, as the ground truth takes them.
        roi: the region.
        dataset: whose rules are applied (``nuscenes`` or ``argoverse2``).

    Returns:
        SHA-256 in hexadecimal.
    """
    digest = hashlib.sha256()
    parts = (
        f"{dataset} {EXTRACTION_VERSION} {roi.length!r} {roi.width!r} {len(poses)}".encode(),
        fingerprint,
        np.ascontiguousarray(poses, dtype=np.float64).tobytes(),
    )
    for part in parts:
        digest.update(len(part).to_bytes(8, "little") + part)
    return digest.hexdigest()


class FrameByFrame(Protocol):
    """What the ground truth of each data set offers for this."""

    fingerprint: bytes

    def frame(self, pose: Float, roi: RegionOfInterest, /) -> FrameTruth:
        """Return the truth around one pose."""
        ...


def all_truths(
    truth: FrameByFrame, poses: Sequence[Float], roi: RegionOfInterest, folder: Path | None, dataset: str
) -> list[FrameTruth]:
    """Return the truth around every pose, from the cache in ``folder`` where it has it (None: no cache)."""

    def compute() -> list[FrameTruth]:
        return [truth.frame(pose, roi) for pose in poses]

    if folder is None:
        return compute()
    return cached_truths(folder, cache_key(truth.fingerprint, poses, roi, dataset), compute)


def cached_truths(folder: Path, key: str, compute: Callable[[], Sequence[FrameTruth]]) -> list[FrameTruth]:
    """Read a scene's ground truth, or compute and keep it. A damaged file is computed and written anew.

    Args:
        folder: of the cache.
        key: see :func:`cache_key`.
        compute: gives the truth of every frame in order.
    """
    path = folder / f"truth-{key}.npz"
    try:
        return _load(path)
    except FileNotFoundError:
        pass
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error):
        path.unlink(missing_ok=True)
    truths = list(compute())
    folder.mkdir(parents=True, exist_ok=True)
    _save(path, truths)
    return truths


def _save(path: Path, truths: Sequence[FrameTruth]) -> None:
    lines = [line for truth in truths for line in truth.polylines]
    arrays = {
        "counts": np.array([len(truth.polylines) for truth in truths], dtype=np.int64),
        "lengths": np.array([len(line) for line in lines], dtype=np.int64),
        "points": np.concatenate([np.zeros((0, 2)), *lines]),
        "kinds": np.concatenate([np.zeros(0, dtype=np.int64), *(truth.kinds for truth in truths)]),
        "element_ids": np.concatenate([np.zeros(0, dtype=np.int64), *(truth.element_ids for truth in truths)]),
    }
    descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=".truth-", suffix=".npz")
    try:
        with os.fdopen(descriptor, "wb") as file:
            np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
        Path(temporary).replace(path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def _load(path: Path) -> list[FrameTruth]:
    with np.load(path, allow_pickle=False) as arrays:
        counts, lengths, points = arrays["counts"], arrays["lengths"], arrays["points"]
        kinds, element_ids = arrays["kinds"], arrays["element_ids"]
    lines = np.split(points, np.cumsum(lengths)[:-1]) if len(lengths) else []
    ends = np.cumsum(counts)
    return [
        FrameTruth(kinds[end - count : end], tuple(lines[end - count : end]), element_ids[end - count : end])
        for count, end in zip(counts.tolist(), ends.tolist(), strict=True)
    ]
