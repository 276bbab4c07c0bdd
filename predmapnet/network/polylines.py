"""Batches of polylines as tensors: resample, clip at the ROI, chamfer distances."""

from __future__ import annotations

import torch
from torch import Tensor

from predmapnet.network.kernels.tracing import is_traced


def resample_polylines(points: Tensor, count: int, start: Tensor | None = None, stop: Tensor | None = None) -> Tensor:
    """Place ``count`` points at equal distances along each line: ``(..., count, 2)``.

    Args:
        points: ``(..., P, 2)``, metres.
        count: points per line afterwards.
        start, stop: ``(...)``, stations along the line in metres between which it is kept; its ends by default.
    """
    steps = torch.diff(points, dim=-2).norm(dim=-1)
    stations = torch.cat([torch.zeros_like(steps[..., :1]), steps.cumsum(dim=-1)], dim=-1)
    start = torch.zeros_like(stations[..., 0]) if start is None else start
    stop = stations[..., -1] if stop is None else stop
    fractions = torch.linspace(0.0, 1.0, count, device=points.device, dtype=points.dtype)
    wanted = start[..., None] + (stop - start)[..., None] * fractions
    right = _first_not_below(stations, wanted).clamp(1, stations.shape[-1] - 1)
    left_station, right_station = stations.gather(-1, right - 1), stations.gather(-1, right)
    share = ((wanted - left_station) / (right_station - left_station).clamp(min=1e-9)).clamp(0.0, 1.0)[..., None]
    corners = right[..., None].expand(*right.shape, 2)
    return points.gather(-2, corners - 1) * (1 - share) + points.gather(-2, corners) * share


def _first_not_below(stations: Tensor, wanted: Tensor) -> Tensor:
    """Return the index of the first of the rising ``stations (..., P)`` that is not below each ``wanted (..., K)``."""
    if is_traced():  # ONNX knows no searchsorted.
        return (stations[..., None, :] < wanted[..., None]).sum(dim=-1)
    return torch.searchsorted(stations.contiguous(), wanted.contiguous())


def clip_polylines(points: Tensor, is_ring: Tensor, roi_size: Tensor) -> tuple[Tensor, Tensor]:
    """Cut polylines at the ROI and spread their points evenly again.

    A line is cut where it first comes in and last goes out; a ring is pressed against the border.

    Args:
        points: ``(..., P, 2)``, normalised; the ROI is the unit square.
        is_ring: ``(...) bool``.
        roi_size: ``(2,)``, metres.

    Returns:
        ``(..., P, 2)`` points in [0, 1], and ``(...) bool``: whether any of the line lies inside.
    """
    first, step = points[..., :-1, :], torch.diff(points, dim=-2)
    safe = torch.where(step.abs() < 1e-9, torch.full_like(step, 1e-9), step)
    borders = torch.stack([-first / safe, (1.0 - first) / safe])
    enter = borders.amin(dim=0).amax(dim=-1).clamp(min=0.0)
    leave = borders.amax(dim=0).amin(dim=-1).clamp(max=1.0)
    crosses = leave >= enter
    inside = crosses.any(dim=-1)

    length = (step * roi_size).norm(dim=-1)
    begin = length.cumsum(dim=-1) - length
    start = (begin + enter * length).masked_fill(~crosses, torch.inf).amin(dim=-1)
    stop = (begin + leave * length).masked_fill(~crosses, -torch.inf).amax(dim=-1)
    pressed = torch.where(is_ring[..., None, None], points.clamp(0.0, 1.0), points)
    whole = is_ring | ~inside
    total = (torch.diff(pressed, dim=-2) * roi_size).norm(dim=-1).sum(dim=-1)
    start, stop = torch.where(whole, 0.0, start), torch.where(whole, total, stop)
    resampled = resample_polylines(pressed * roi_size, points.shape[-2], start, stop) / roi_size
    return resampled.clamp(0.0, 1.0), inside


def chamfer_distances(first: Tensor, second: Tensor) -> Tensor:
    """Return chamfer distances ``(M,)`` of pairs of lines ``(M, K, 2)``, as in :mod:`mapfusion.geometry`."""
    # Several times faster than torch.cdist, which knows no short way for two coordinates.
    x = first[:, :, None, 0] - second[:, None, :, 0]
    y = first[:, :, None, 1] - second[:, None, :, 1]
    squared = x.square_().add_(y.square_())
    forward, backward = squared.amin(dim=2).sqrt().mean(dim=1), squared.amin(dim=1).sqrt().mean(dim=1)
    return (forward + backward) / 2
