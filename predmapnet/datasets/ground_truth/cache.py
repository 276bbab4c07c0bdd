"""Cache of ground truth on disk, keyed by everything that it depends on.

A key that leaves something out goes stale unseen: annotation caches that outlived a change of their region or split
have spoilt published figures. So the key covers the map's bytes, every pose, the region, the text of the code that
extracts, and the versions of the libraries that do the geometry.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import shapely
from numpy.typing import NDArray

from mapfusion import geometry
from mapfusion.array_files import read_arrays
from mapfusion.arrays import Float
from mapfusion.elements import RegionOfInterest
from mapfusion.files import write_whole
from predmapnet.datasets import poses as poses_module
from predmapnet.errors import UserError
from predmapnet.scenes import FrameTruth


@cache
def code_fingerprint() -> bytes:
    """Digest of the ground-truth code as it is installed, and of the libraries that compute for it."""
    digest = hashlib.sha256(
        f"numpy {np.__version__} shapely {shapely.__version__} geos {shapely.geos_version}".encode()
    )
    for path in (*sorted(Path(__file__).parent.glob("*.py")), Path(geometry.__file__), Path(poses_module.__file__)):
        digest.update(path.name.encode() + path.read_bytes())
    return digest.digest()


def cache_key(fingerprint: bytes, poses: Sequence[Float], roi: RegionOfInterest, dataset: str) -> str:
    """Return the name of a scene's ground truth, SHA-256 in hexadecimal.

    Args:
        fingerprint: digest of the map file as it lies on disk.
        poses: of each frame, as the ground truth takes them.
        roi: the region.
        dataset: whose rules are applied (``nuscenes`` or ``argoverse2``).
    """
    digest = hashlib.sha256()
    parts = (
        f"{dataset} {roi.length!r} {roi.width!r} {len(poses)}".encode(),
        code_fingerprint(),
        fingerprint,
        np.ascontiguousarray(poses, dtype=np.float64).tobytes(),
    )
    for part in parts:
        digest.update(len(part).to_bytes(8, "little") + part)
    return digest.hexdigest()


class FrameByFrame(Protocol):
    """Ground truth that can be asked for the truth around a pose."""

    fingerprint: bytes

    def frame(self, pose: Float, roi: RegionOfInterest, /) -> FrameTruth:
        """Return the truth around one pose."""


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
    """Read a scene's ground truth by its :func:`cache_key`, or compute and keep that of all frames in order.

    A damaged file is computed and written anew; a folder that cannot be written to raises UserError.
    """
    path = folder / f"truth-{key}.npz"
    with contextlib.suppress(OSError, ValueError):
        return truths_of_arrays(read_arrays(path))
    truths = list(compute())
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _save(path, truths)
    except OSError as error:
        raise UserError(
            f"The ground truth cannot be kept in {folder} ({error.strerror or error}): set PREDMAPNET_CACHE to another "
            "folder, or do without."
        ) from error
    return truths


def truth_arrays(truths: Sequence[FrameTruth]) -> dict[str, NDArray[np.generic]]:
    """Return the truth of many frames as few arrays, for a file of numpy's."""
    lines = [line for truth in truths for line in truth.polylines]
    return {
        "counts": np.array([len(truth.polylines) for truth in truths], dtype=np.int64),
        "lengths": np.array([len(line) for line in lines], dtype=np.int64),
        "points": np.concatenate([np.zeros((0, 2)), *lines]),
        "kinds": np.concatenate([np.zeros(0, dtype=np.int64), *(truth.kinds for truth in truths)]),
        "element_ids": np.concatenate([np.zeros(0, dtype=np.int64), *(truth.element_ids for truth in truths)]),
    }


def truths_of_arrays(arrays: Mapping[str, NDArray[Any]]) -> list[FrameTruth]:
    """Return what :func:`truth_arrays` was given. Raises ValueError for arrays of another kind."""
    kinds_of_arrays = {"lengths": "i", "points": "f", "kinds": "i", "element_ids": "i", "counts": "i"}
    found = [arrays.get(name, np.zeros(0, dtype=bool)) for name in kinds_of_arrays]
    if [array.dtype.kind for array in found] != [*kinds_of_arrays.values()]:
        raise ValueError(f"arrays {', '.join(kinds_of_arrays)} are expected")
    lengths, points, kinds, element_ids, counts = found
    if [array.ndim for array in found] != [1, 2, 1, 1, 1]:
        raise ValueError("the arrays have not as many axes as they should")
    whole = len(lengths) == len(kinds) == len(element_ids) == counts.sum() and lengths.sum() == len(points)
    if not whole or points.shape != (len(points), 2) or (lengths < 0).any() or (counts < 0).any():
        raise ValueError("the arrays do not fit each other")
    lines = np.split(points, np.cumsum(lengths)[:-1]) if len(lengths) else []
    ends = np.cumsum(counts)
    return [
        FrameTruth(kinds[end - count : end], tuple(lines[end - count : end]), element_ids[end - count : end])
        for count, end in zip(counts.tolist(), ends.tolist(), strict=True)
    ]


def _save(path: Path, truths: Sequence[FrameTruth]) -> None:
    with write_whole(path) as temporary:
        np.savez_compressed(temporary, **truth_arrays(truths))  # type: ignore[arg-type]
