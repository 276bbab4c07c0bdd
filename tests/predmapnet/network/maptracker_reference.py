"""The MapTracker fixtures: weights, inputs, expected values, and what a network makes of them."""

import importlib.util
import json
import math
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, cached_property, lru_cache
from pathlib import Path
from types import ModuleType

import numpy as np
import torch
from torch import Tensor, nn

from predmapnet.network.calibration import Calibration
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.network.state import FrameInputs
from predmapnet.weights.maptracker_import import import_maptracker

PROJECT = Path(__file__).resolve().parents[3]
FOLDER = Path(os.environ.get("PREDMAPNET_REFERENCE", PROJECT.parent / "shared" / "reference" / "public")) / "maptracker"
REGION = {"head.roi_size": [60.0, 30.0], "head.origin": [-30.0, -15.0]}


class Reference:
    """A folder of fixtures."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @cached_property
    def spec(self) -> ModuleType:
        spec = importlib.util.spec_from_file_location("maptracker_refspec", self.folder / "refspec.py")
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    @cached_property
    def entries(self) -> list[dict[str, object]]:
        return json.loads((self.folder / "state_dict_keys.json").read_text())["keys"]

    @cached_property
    def official_state(self) -> dict[str, Tensor]:
        """The state dict that the official code would have written."""
        x, y = np.linspace(-30, 30, 100, dtype=np.float32), np.linspace(15, -15, 50, dtype=np.float32)
        plane = np.stack([*np.meshgrid(x, y), np.zeros((50, 100)), np.ones((50, 100))], axis=-1)
        state = {}
        for entry in self.entries:
            name, shape = str(entry["name"]), entry["shape"]
            values = self.spec.make_tensor(name, shape)
            if values is not None:
                state[name] = torch.from_numpy(values)
            elif name in REGION:
                state[name] = torch.tensor(REGION[name])
            else:
                state[name] = torch.from_numpy(plane) if name == "plane" else torch.zeros(shape, dtype=torch.int64)
        return state

    @cached_property
    def network(self) -> PredMapNet:
        return import_maptracker(self.official_state)[0]

    def sizes(self) -> list[tuple[int, int]]:
        """Image sizes, small ones first."""
        names = (re.match(r"ref_(\d+)x(\d+)_frame0\.npz", path.name) for path in self.folder.iterdir())
        return sorted((int(found[1]), int(found[2])) for found in names if found)

    def frames(self, size: tuple[int, int]) -> int:
        return len(list(self.folder.glob(f"ref_{size[0]}x{size[1]}_frame*.npz")))

    def expected(self, size: tuple[int, int], frame: int) -> dict[str, np.ndarray]:
        with np.load(self.folder / f"ref_{size[0]}x{size[1]}_frame{frame}.npz") as values:
            return dict(values)

    def inputs(self, size: tuple[int, int], frame: int, frames: int) -> FrameInputs:
        translations, rotations = self.spec.poses(frames)
        images = torch.from_numpy(self.spec.images(frame, *size))[None]
        return FrameInputs(
            images=images,
            camera_valid=torch.ones(images.shape[:2], dtype=torch.bool),
            ego_to_global=pose(rotations[frame], translations[frame])[None],
            calibration=self.calibration(size),
        )

    def calibration(self, size: tuple[int, int]) -> Calibration:
        ego_to_image = torch.from_numpy(self.spec.ego2img(*size))[None, :, :3]
        cameras = ego_to_image.shape[1]
        return Calibration(
            ego_to_image=ego_to_image,
            image_size=torch.tensor(size[::-1], dtype=torch.float64).expand(1, cameras, 2),
            ground_height=torch.zeros(1, cameras, dtype=torch.float64),
            camera_code=torch.arange(cameras)[None],
        )


@cache
def load_reference() -> Reference:
    return Reference(FOLDER)


def pose(rotation: np.ndarray, translation: np.ndarray) -> Tensor:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return torch.from_numpy(matrix)


def difference(found: Tensor | np.ndarray, expected: dict[str, np.ndarray], name: str, spec: ModuleType) -> float:
    """Largest absolute difference from a fixture, which is a whole array or a summary; infinite for another shape."""
    values = found.detach().cpu().numpy() if isinstance(found, Tensor) else found
    whole = expected.get(name)
    shape = tuple(whole.shape if whole is not None else expected[f"{name}|shape"])
    if values.size == 0 and np.prod(shape) == 0:
        return 0.0
    if values.shape != shape:
        return math.inf
    if whole is not None:
        return float(np.abs(values.astype(np.float64) - whole.astype(np.float64)).max())
    parts = zip(summary(values, spec), ("stats", "proj", "sample"), strict=True)
    return max(float(np.abs(part - expected[f"{name}|{kind}"]).max()) for part, kind in parts)


def summary(values: np.ndarray, spec: ModuleType) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Statistics, projections and samples as ``spec.summary`` makes them, without drawing the same noise again."""
    flat = np.ascontiguousarray(values).reshape(-1).astype(np.float64)
    projections = [np.dot(noise(seed, flat.size), flat) / math.sqrt(flat.size) for seed in range(spec.NPROJ)]
    places = np.arange(min(flat.size, spec.NSAMP)) * flat.size // min(flat.size, spec.NSAMP)
    return np.array([flat.mean(), flat.std(), flat.min(), flat.max()]), np.array(projections), flat[places]


@lru_cache(maxsize=40)
def noise(seed: int, count: int) -> np.ndarray:
    return np.random.Generator(np.random.PCG64(7919 + seed)).standard_normal(count)


@contextmanager
def recorded(modules: dict[str, nn.Module]) -> Iterator[dict[str, list[tuple[tuple[Tensor, ...], Tensor]]]]:
    """Record each call of modules while the block runs: what went in, and what came out."""
    seen: dict[str, list[tuple[tuple[Tensor, ...], Tensor]]] = {name: [] for name in modules}

    def keep(name: str) -> Callable[..., None]:
        def hook(module: nn.Module, arguments: tuple[Tensor, ...], output: Tensor) -> None:
            seen[name].append((arguments, output))

        return hook

    handles = [module.register_forward_hook(keep(name)) for name, module in modules.items()]
    try:
        yield seen
    finally:
        for handle in handles:
            handle.remove()
