"""From image features to the ground plane: a sparse look-up that is computed once per camera rig."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from predmapnet.config import PredMapNetConfig
from predmapnet.datasets.source import Camera, Float, Rig
from predmapnet.network.image_backbone import STRIDE
from predmapnet.network.image_input import input_size, window_intrinsics
from predmapnet.network.layers import cell_centres

Integer = NDArray[np.int64]


@dataclass(frozen=True)
class SparseRows:
    """A sparse matrix, row by row.

    Attributes:
        columns: ``(nnz,) int64``.
        starts: ``(rows,) int64``, where each row begins in ``columns``.
        weights: ``(nnz,) float32``.
    """

    columns: Tensor
    starts: Tensor
    weights: Tensor

    @classmethod
    def from_entries(cls, rows: Tensor, columns: Tensor, weights: Tensor, row_count: int) -> SparseRows:
        """Sort entries by row."""
        order = torch.argsort(rows, stable=True)
        counts = torch.bincount(rows, minlength=row_count)
        return cls(columns[order].contiguous(), torch.cumsum(counts, 0) - counts, weights[order].contiguous())

    def multiply(self, table: Tensor) -> Tensor:
        """Multiply with ``(columns, C)``; an embedding bag is several times faster than a CSR product on a CPU."""
        return F.embedding_bag(self.columns, table, self.starts, per_sample_weights=self.weights, mode="sum")

    def to(self, device: torch.device | str) -> SparseRows:
        """Return a copy on ``device``."""
        return SparseRows(self.columns.to(device), self.starts.to(device), self.weights.to(device))


@dataclass(frozen=True)
class RigLookup:
    """Which image features each ground cell sees. Belongs to a rig, not to the network; not trained.

    Attributes:
        gather: ground cells x feature pixels of all cameras: bilinear weights, summed over cameras.
        scatter: the transpose, for the backward pass.
        visible: ``(cells, N) float32``, 1 where a camera sees the centre of a cell.
        grid: rows and columns of ground cells.
        feature_size: rows and columns of the image features.
    """

    gather: SparseRows
    scatter: SparseRows
    visible: Tensor
    grid: tuple[int, int]
    feature_size: tuple[int, int]

    def to(self, device: torch.device | str) -> RigLookup:
        """Return a copy on ``device``."""
        return replace(
            self, gather=self.gather.to(device), scatter=self.scatter.to(device), visible=self.visible.to(device)
        )


def make_rig_lookup(rig: Rig, config: PredMapNetConfig) -> RigLookup:
    """Project the centres of all ground cells (at the height of the road under the car) into all cameras.

    Args:
        rig: cameras at the size of their stored images; scaling and the window are taken care of here.
        config: image and grid sizes.
    """
    grid = (2 * config.bev.rows, 2 * config.bev.columns)
    rows, columns = (-(-size // STRIDE) for size in input_size(config.image))
    roi = config.roi
    ground = (cell_centres(*grid).double().numpy().reshape(-1, 2) - 0.5) * roi.size
    entries: list[tuple[Integer, Integer, Float]] = []
    visible = np.zeros((len(ground), len(rig)), dtype=np.float32)
    for number, camera in enumerate(rig):
        pixels, seen = _project(ground, camera, config)
        visible[seen, number] = 1.0
        cells = np.flatnonzero(seen)
        for corner, share in _bilinear(pixels[cells] / STRIDE - 0.5, rows, columns):
            entries.append((cells, corner + number * rows * columns, share))
    cell, pixel, weight = (torch.from_numpy(np.concatenate(parts)) for parts in zip(*entries, strict=True))
    weight = weight.float()
    return RigLookup(
        gather=SparseRows.from_entries(cell, pixel, weight, len(ground)),
        scatter=SparseRows.from_entries(pixel, cell, weight, len(rig) * rows * columns),
        visible=torch.from_numpy(visible),
        grid=grid,
        feature_size=(rows, columns),
    )


def _project(ground: Float, camera: Camera, config: PredMapNetConfig) -> tuple[Float, NDArray[np.bool_]]:
    """Return pixels ``(n, 2)`` in the network's window, and whether each point is inside it."""
    rotation, position = camera.camera_to_ego[:3, :3], camera.camera_to_ego[:3, 3]
    points = (np.column_stack([ground, np.full(len(ground), camera.ground_height)]) - position) @ rotation
    depth = points[:, 2]
    projected = points @ window_intrinsics(camera, config.image).T
    pixels = projected[:, :2] / np.maximum(depth, 1e-3)[:, None]
    size = np.array([config.image.width, config.image.height])
    return pixels, (depth > 0.1) & (pixels >= 0).all(axis=1) & (pixels < size).all(axis=1)


def _bilinear(pixels: Float, rows: int, columns: int) -> list[tuple[Integer, Float]]:
    """Return the four neighbours of each position (flat index, clamped at the border) and their weights."""
    base = np.floor(pixels)
    fraction = pixels - base
    corners = []
    for right in (0, 1):
        for down in (0, 1):
            x = np.clip(base[:, 0] + right, 0, columns - 1).astype(np.int64)
            y = np.clip(base[:, 1] + down, 0, rows - 1).astype(np.int64)
            weight = np.abs(1 - right - fraction[:, 0]) * np.abs(1 - down - fraction[:, 1])
            corners.append((y * columns + x, weight))
    return corners


class _SparseProduct(torch.autograd.Function):
    """Multiply each stream's features with the sparse matrix; the stored transpose serves the backward pass."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, lookup: RigLookup) -> Tensor:
        ctx.scatter = lookup.scatter
        return torch.stack([lookup.gather.multiply(table) for table in features])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return torch.stack([ctx.scatter.multiply(table) for table in gradient.contiguous()]), None


def to_ground(features: Tensor, camera_valid: Tensor, lookup: RigLookup) -> Tensor:
    """Look image features up at every ground cell: the mean over the cameras that see it and are valid.

    Args:
        features: ``(B, N, C, h', w')``.
        camera_valid: ``(B, N) bool``.
        lookup: of the rig that took the images.

    Returns:
        ``(B, C, rows, columns)``, channels-last in memory; zero where no valid camera looks.
    """
    batch = len(features)
    features = features.masked_fill(~camera_valid[:, :, None, None, None], 0.0)
    pixels = features.permute(0, 1, 3, 4, 2).reshape(batch, -1, features.shape[2])
    summed = _SparseProduct.apply(pixels, lookup)  # type: ignore[no-untyped-call]
    cameras = camera_valid.to(summed.dtype) @ lookup.visible.to(summed.dtype).T
    ground = summed / cameras.clamp(min=1.0)[..., None]
    return ground.unflatten(1, lookup.grid).permute(0, 3, 1, 2)
