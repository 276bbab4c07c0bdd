"""Training cache: frames at the network's image size, a file each, with all that training needs of them.

One scene is one folder. ``000012.npz`` holds the images of a frame as one JPEG, all cameras one below the other, and
pose, calibration, truth and depth, each with a checksum; ``index.npz`` is written last and says which frames there are.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from hashlib import sha256
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from mapfusion.array_files import read_arrays
from mapfusion.arrays import Float
from predmapnet.config import BevFormerConfig, PredMapNetConfig
from predmapnet.datasets.ground_truth.cache import truth_arrays, truths_of_arrays
from predmapnet.errors import UserError
from predmapnet.files import write_file
from predmapnet.network.calibration import Calibration
from predmapnet.scenes import FrameTruth

Images = NDArray[np.uint8]

INDEX = "index.npz"
JPEG_OPTIONS = (cv2.IMWRITE_JPEG_QUALITY, 90, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)


@dataclass(frozen=True)
class CachedFrame:
    """One frame, ready for training.

    Attributes:
        ego_to_global: ``(4, 4) float64``.
        calibration: of the cameras, as a batch of one.
        truth: clipped to the region.
        images: ``(N, h, w, 3) uint8``, RGB, after the network's preprocessing; without cameras where
            nobody asked for them.
        camera_valid: ``(N,) bool``, cameras that have an image.
        depth: ``(N, h', w') int64`` of :func:`~.depth_targets.depth_of_frame`; None where the
            network learns none.
    """

    ego_to_global: Float
    calibration: Calibration
    truth: FrameTruth
    images: Images
    camera_valid: NDArray[np.bool_]
    depth: NDArray[np.int64] | None = None


def cache_folder(cache: Path, dataset: str, config: PredMapNetConfig) -> Path:
    """Name the cache of a data set by all that images, codes of cameras, truth and depth depend on.

    Args:
        cache: folder of all caches.
        dataset: its name, with what tells it from others of that name.
        config: of the network.
    """
    depth = f" {config.depth} {config.bev.kind}" if config.depth.enabled else ""
    codes = f" {config.bev.cameras}" if isinstance(config.bev, BevFormerConfig) else ""
    key = f"{config.image} {config.bev.kind} {config.roi_length} {config.roi_width}{depth}{codes}"
    return cache / f"{dataset}-{config.image.width}x{config.image.height}-{sha256(key.encode()).hexdigest()[:8]}"


def frame_path(folder: Path, number: int) -> Path:
    """Return the file of a frame of a scene."""
    return folder / f"{number:06d}.npz"


def frame_arrays(ego_to_global: Float, calibration: Calibration, truth: FrameTruth) -> dict[str, NDArray[Any]]:
    """Return what is stored of a frame besides images and depth."""
    cameras = {name: value.numpy() for name, value in vars(calibration).items()}
    return {"ego_to_global": ego_to_global, **cameras, **truth_arrays([truth])}


def encoded_images(images: Images, valid: NDArray[np.bool_]) -> dict[str, NDArray[Any]]:
    """Return what is stored of the images ``(N, h, w, 3)`` of a frame and of which cameras have one."""
    jpeg = cv2.imencode(".jpg", images.reshape(-1, *images.shape[2:])[:, :, ::-1], JPEG_OPTIONS)[1]
    return {"images": jpeg, "camera_valid": valid}


def write_arrays(path: Path, arrays: dict[str, NDArray[Any]]) -> None:
    """Write arrays as one file; each has a checksum in it."""
    with write_file(path) as temporary:
        np.savez(temporary, **arrays)  # type: ignore[arg-type]


@contextmanager
def damage_told(path: Path) -> Iterator[None]:
    """Raise as a UserError what a reader trips over in a file that is missing or damaged."""
    try:
        yield
    except (OSError, ValueError, KeyError, IndexError, TypeError, BadZipFile, cv2.error) as error:
        raise UserError(f"{path} of the training cache is damaged ({error}). Train again: it is made anew.") from None


class CachedScene:
    """One scene of the cache.

    Attributes:
        folder: where it lies.
        name: of the scene.
        with_crossing: ``(n,) bool``, frames that see a crossing.
    """

    def __init__(self, folder: Path) -> None:
        """Open a scene. Raises UserError where it is not there or not complete."""
        self.folder, self.name = folder, folder.name
        with damage_told(folder / INDEX):
            index = read_arrays(folder / INDEX)
            self.with_crossing = index["with_crossing"].astype(np.bool_)
            self._numbers = index["numbers"].astype(np.int64).reshape(len(self.with_crossing))

    def __len__(self) -> int:
        return len(self._numbers)

    def digest(self) -> str:
        """Tell the frames of this scene from all others. Raises UserError where one is missing or damaged."""
        found = sha256()
        for number in self._numbers.tolist():
            path = frame_path(self.folder, number)
            with damage_told(path), ZipFile(path) as archive:
                found.update(repr([(member.filename, member.CRC) for member in archive.infolist()]).encode())
        return found.hexdigest()[:20]

    def frame(self, index: int, images: bool = True) -> CachedFrame:
        """Read one frame, its images (and its depth) only where they are asked for. Raises UserError for damage."""
        path = frame_path(self.folder, int(self._numbers[index]))
        with damage_told(path):
            arrays = read_arrays(path, without=("origin",) if images else ("origin", "images", "camera_valid", "depth"))
            pixels, valid = np.zeros((0, 0, 0, 3), np.uint8), np.zeros(0, np.bool_)
            if images:
                stacked = np.asarray(cv2.imdecode(arrays["images"], cv2.IMREAD_COLOR_RGB), np.uint8)
                valid = arrays["camera_valid"]
                pixels = stacked.reshape(len(valid), -1, *stacked.shape[1:])
            calibration = {each.name: torch.from_numpy(arrays[each.name]) for each in fields(Calibration)}
            return CachedFrame(
                ego_to_global=arrays["ego_to_global"],
                calibration=Calibration(**calibration),
                truth=truths_of_arrays(arrays)[0],
                images=pixels,
                camera_valid=valid,
                depth=arrays["depth"].astype(np.int64) if "depth" in arrays else None,
            )


@dataclass(frozen=True)
class TrainingScenes:
    """Cached scenes of any cars, to be trained on.

    Attributes:
        scenes: all of them.
        weights: of each scene: how often each of its frames is seen in an epoch.
        config: of the network.
    """

    scenes: Sequence[CachedScene]
    weights: Sequence[float]
    config: PredMapNetConfig

    @property
    def digest(self) -> str:
        """Tell what is drawn from: scenes, their order and their weights."""
        named = [(scene.folder.parent.name, scene.name, len(scene)) for scene in self.scenes]
        return sha256(repr((named, list(self.weights))).encode()).hexdigest()[:20]
