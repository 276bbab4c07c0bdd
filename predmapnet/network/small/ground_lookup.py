"""Ground look-up: image features at cells of the ground, by a sparse product made from the calibration of a frame."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from mapfusion.elements import RegionOfInterest
from predmapnet.network.calibration import Calibration
from predmapnet.network.kernels.tracing import is_traced
from predmapnet.network.layers import cell_centres

NEAREST_DEPTH = 0.1
"""Metres before the camera from which on a point is seen."""


@dataclass(frozen=True)
class SparseRows:
    """A sparse matrix, row by row: columns and weights ``(nnz,)``, and where each row begins in them, ``(rows,)``."""

    columns: Tensor
    starts: Tensor
    weights: Tensor

    def transposed(self, columns: int) -> SparseRows:
        """Return the transpose of a matrix with that many columns."""
        on_host = self.columns.device.type == "cpu"
        return self._transposed_by_counting(columns) if on_host else self._transposed_by_sorting(columns)

    def _transposed_by_sorting(self, columns: int) -> SparseRows:
        counts = torch.diff(self.starts, append=self.starts.new_tensor([len(self.columns)]))
        rows = torch.arange(len(self.starts), device=counts.device, dtype=torch.int32).repeat_interleave(counts)
        order = torch.argsort(self.columns, stable=True)
        starts = row_starts(torch.bincount(self.columns, minlength=columns))
        return SparseRows(rows.index_select(0, order), starts, self.weights.index_select(0, order))

    def _transposed_by_counting(self, columns: int) -> SparseRows:
        """Return the same, on a CPU three times as fast."""
        from scipy.sparse import csr_matrix  # Training alone takes this long import.

        starts = np.append(self.starts.numpy(), np.int32(len(self.columns)))
        rows = (self.weights.numpy(), self.columns.numpy(), starts)
        turned = csr_matrix(rows, shape=(len(self.starts), columns)).tocsc()
        found = (torch.from_numpy(each) for each in (turned.indices, turned.indptr[:-1], turned.data))
        return SparseRows(*found)

    def multiply(self, table: Tensor) -> Tensor:
        """Multiply with ``(columns, C)``; an embedding bag is several times faster than a CSR product on a CPU."""
        if is_traced():  # ONNX has no bags.
            begins = self.starts.new_zeros(self.columns.shape[0] + 1, dtype=torch.int64)
            rows = (
                begins.index_add(0, self.starts.long(), torch.ones_like(self.starts, dtype=torch.int64)).cumsum(0) - 1
            )
            entries = table[self.columns.long()] * self.weights[:, None]
            return table.new_zeros(len(self.starts), table.shape[1]).index_add(0, rows[:-1], entries)
        return F.embedding_bag(self.columns, table, self.starts, per_sample_weights=self.weights, mode="sum")


@dataclass(frozen=True)
class GroundLookup:
    """Image features that each point of the ground sees, in ``B`` frames of ``N`` cameras and ``K`` points.

    Attributes:
        gather: points of all frames x feature pixels of all cameras of all frames: bilinear weights, summed over the
            cameras of a frame.
        pixels: as many as ``gather`` has columns.
        visible: ``(B, K, N) float32``, 1 where a camera sees a point.
    """

    gather: SparseRows
    pixels: int
    visible: Tensor

    @cached_property
    def scatter(self) -> SparseRows:
        """The transpose of ``gather``, for the backward pass."""
        return self.gather.transposed(self.pixels)


def ground_points(grid: tuple[int, int], height: float, roi: RegionOfInterest) -> Tensor:
    """Return cell centres ``(rows * columns, 4) float64``: x, y (ego frame), height above the road, metres; and 1."""
    x, y = ((cell_centres(*grid).double() - 0.5) * torch.tensor(roi.size)).flatten(0, 1).unbind(-1)
    return torch.stack([x, y, torch.full_like(x, height), torch.ones_like(x)], dim=-1)


def find_on_ground(
    points: Tensor, calibration: Calibration, feature_size: tuple[int, int], stride: int
) -> GroundLookup:
    """Project points ``(K, 4) float64`` of :func:`ground_points` into all cameras of all frames.

    Image features have ``feature_size`` rows and columns, one for ``stride`` pixels of the network's input.
    """
    batch, cameras = calibration.camera_code.shape
    u, v, depth = _project(points, calibration)
    width, height = calibration.image_size[..., None].unbind(2)
    seen = depth > NEAREST_DEPTH
    for inside in (u >= 0, v >= 0, u < width * depth, v < height * depth):
        seen &= inside
    visible = seen.transpose(1, 2)
    # Point after point, so that the entries of each row follow one another.
    frame, point, camera = visible.nonzero(as_tuple=True)
    view = frame * cameras + camera
    u, v, depth = (value.flatten().index_select(0, view * len(points) + point) for value in (u, v, depth))
    pixels = feature_size[0] * feature_size[1]
    corners, shares = _bilinear(
        u / depth / stride - 0.5, v / depth / stride - 0.5, *feature_size, (view * pixels).int()
    )
    return GroundLookup(
        gather=SparseRows(
            columns=corners.flatten(), starts=row_starts(4 * seen.sum(dim=1).flatten()), weights=shares.flatten()
        ),
        pixels=batch * cameras * pixels,
        visible=visible.float(),
    )


def row_starts(entries: Tensor) -> Tensor:
    """Return where each row of a sparse matrix begins, ``(rows,) int32``, of its number of entries."""
    return (entries.cumsum(0) - entries).int()


def _project(points: Tensor, calibration: Calibration) -> tuple[Tensor, Tensor, Tensor]:
    """Return u depth, v depth and depth, ``(B, N, K) float64`` each."""
    matrices = calibration.ego_to_image
    at_road = matrices[..., 3] + matrices[..., 2] * calibration.ground_height[..., None]
    matrices = torch.cat([matrices[..., :3], at_road[..., None]], dim=-1)
    u, v, depth = (matrices.movedim(2, 0).flatten(0, 2) @ points.T).unflatten(0, (3, *matrices.shape[:2])).unbind(0)
    return u, v, depth


def _bilinear(x: Tensor, y: Tensor, rows: int, columns: int, first: Tensor) -> tuple[Tensor, Tensor]:
    """Return the four neighbours ``(n, 4) int32`` of each position (flat, clamped at the border) and their weights.

    ``first (n,) int32`` is where the pixels of each position's map begin.
    """
    left, top = x.floor(), y.floor()
    right, down = (x - left).float(), (y - top).float()
    left, top = left.int(), top.int()
    near_x, far_x = left.clamp(0, columns - 1), (left + 1).clamp(0, columns - 1)
    near_y, far_y = (row.clamp(0, rows - 1) * columns + first for row in (top, top + 1))
    corners = torch.stack([near_y + near_x, far_y + near_x, near_y + far_x, far_y + far_x], dim=-1)
    shares = [(1 - right) * (1 - down), (1 - right) * down, right * (1 - down), right * down]
    return corners, torch.stack(shares, dim=-1)


class _CameraMean(torch.autograd.Function):
    """Multiply features with the sparse matrix, and divide by how many cameras see each point ``(B * K, 1)``.

    The transpose serves the backward pass.
    """

    @staticmethod
    def forward(ctx: Any, table: Tensor, lookup: GroundLookup, cameras: Tensor) -> Tensor:
        ctx.lookup, ctx.cameras = lookup, cameras
        return lookup.gather.multiply(table).div_(cameras)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        return ctx.lookup.scatter.multiply(gradient / ctx.cameras), None, None


def _differentiable_mean(table: Tensor, lookup: GroundLookup, cameras: Tensor) -> Tensor:
    return _CameraMean.apply(table, lookup, cameras)  # type: ignore[no-untyped-call]


def to_ground(features: Tensor, camera_valid: Tensor, lookup: GroundLookup) -> Tensor:
    """Look image features up at every point of the ground: the mean over the cameras that see it and are valid.

    Args:
        features: ``(B, N, C, h', w')``.
        camera_valid: ``(B, N) bool``.
        lookup: of the calibration of these frames.

    Returns:
        ``(B, K, C)``; zero where no valid camera looks.
    """
    pixels = features.movedim(2, -1).masked_fill(~camera_valid[:, :, None, None, None], 0.0)
    table = pixels.reshape(-1, features.shape[2]).to(lookup.gather.weights.dtype)
    seeing = lookup.visible.to(table.dtype) @ camera_valid.to(table.dtype)[..., None]
    cameras = seeing.clamp(min=1.0).flatten(0, 1)
    if torch.is_grad_enabled():
        found = _differentiable_mean(table, lookup, cameras)
    else:
        found = lookup.gather.multiply(table).div_(cameras)
    return found.unflatten(0, seeing.shape[:2])
