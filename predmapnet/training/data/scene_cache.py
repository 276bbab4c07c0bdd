"""Training cache: scenes as arrays at the network's image size, memory-mapped from disk.

One scene is one folder: ``images.npy`` after the network's preprocessing, ``frames.npz`` with poses and truth,
``rig.json``, and ``lidar.npy`` with all sweeps one after the other where a network learns depth. A folder appears
under its name only when it is complete.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import orjson
from numpy.typing import NDArray

from predmapnet.errors import UserError
from predmapnet.scenes import Camera, FrameTruth, Rig

Float = NDArray[np.float64]
Images = NDArray[np.uint8]

LIDAR_FILE = "lidar.npy"


@dataclass(frozen=True)
class CachedScene:
    """One scene, ready for training.

    Attributes:
        name: of the scene.
        rig: the cameras as the data set describes them (before preprocessing).
        images: ``(n, N, h, w, 3) uint8``, RGB, after the network's preprocessing; memory-mapped.
        ego_to_global: ``(n, 4, 4) float64``.
        truths: ``n`` times the truth of a frame, clipped to the ROI.
        lidar: ``n`` sweeps ``(k_i, 3) float32``, metres, ego frame; memory-mapped; None where nobody asked for them.
    """

    name: str
    rig: Rig
    images: Images
    ego_to_global: Float
    truths: tuple[FrameTruth, ...]
    lidar: tuple[NDArray[np.float32], ...] | None = None

    def __len__(self) -> int:
        return len(self.images)


def write_cached_scene(
    folder: Path,
    rig: Rig,
    images: Images,
    ego_to_global: Float,
    truths: Sequence[FrameTruth],
    lidar: Sequence[Float] | None = None,
) -> None:
    """Write one scene; the folder appears only when it is complete.

    Args:
        folder: where to; its name is the scene's.
        rig: the cameras before preprocessing.
        images: ``(n, N, h, w, 3) uint8``.
        ego_to_global: ``(n, 4, 4) float64``.
        truths: one per frame.
        lidar: one sweep ``(k, 3)`` per frame, metres, ego frame, or None.
    """
    partial = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    np.save(partial / "images.npy", images)
    lines = [line for truth in truths for line in truth.polylines]
    np.savez(
        partial / "frames.npz",
        ego_to_global=ego_to_global,
        pieces=np.array([len(truth.kinds) for truth in truths], dtype=np.int64),
        kinds=np.concatenate([np.zeros(0, np.int64), *(truth.kinds for truth in truths)]),
        element_ids=np.concatenate([np.zeros(0, np.int64), *(truth.element_ids for truth in truths)]),
        vertices=np.array([len(line) for line in lines], dtype=np.int64),
        points=np.concatenate([np.zeros((0, 2)), *lines]),
        sweeps=np.array([len(sweep) for sweep in lidar or ()], dtype=np.int64),
    )
    if lidar is not None:
        np.save(partial / LIDAR_FILE, np.concatenate(lidar).astype(np.float32))
    (partial / "rig.json").write_bytes(
        orjson.dumps([asdict(camera) for camera in rig], option=orjson.OPT_SERIALIZE_NUMPY)
    )
    shutil.rmtree(folder, ignore_errors=True)
    partial.rename(folder)


def read_cached_scene(folder: Path) -> CachedScene:
    """Open one scene of the cache; images stay on disk until they are used.

    Raises:
        UserError: the folder does not hold what :func:`write_cached_scene` writes.
    """
    try:
        images = np.load(folder / "images.npy", mmap_mode="r")
        with np.load(folder / "frames.npz") as stored:
            arrays = {name: stored[name] for name in stored.files}
        sweeps = np.load(folder / LIDAR_FILE, mmap_mode="r") if (folder / LIDAR_FILE).exists() else None
        rig = tuple(_camera(entry) for entry in orjson.loads((folder / "rig.json").read_bytes()))
    except (OSError, ValueError, KeyError) as error:
        raise UserError(f"{folder} of the training cache is damaged ({error}). Delete it and train again.") from None
    lines = np.split(arrays["points"], np.cumsum(arrays["vertices"])[:-1]) if len(arrays["vertices"]) else []
    ends = np.cumsum(arrays["pieces"])
    truths = tuple(
        FrameTruth(arrays["kinds"][start:end], tuple(lines[start:end]), arrays["element_ids"][start:end])
        for start, end in zip(ends - arrays["pieces"], ends, strict=True)
    )
    lidar = None if sweeps is None else tuple(np.split(sweeps, np.cumsum(arrays["sweeps"])[:-1]))
    return CachedScene(folder.name, rig, images, arrays["ego_to_global"], truths, lidar)


def _camera(entry: dict[str, object]) -> Camera:
    matrices = {name: np.array(entry[name], dtype=np.float64) for name in ("intrinsics", "camera_to_ego")}
    return Camera(**{**entry, **matrices})  # type: ignore[arg-type]
