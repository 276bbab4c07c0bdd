"""Losses of the instants of a step, gathered as sums and counts: processes divide by their common mean counts."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from mapfusion.elements import ElementKind
from predmapnet.network.state import FrameOutputs
from predmapnet.training.losses.matching import Matched, Truth, best_order
from predmapnet.training.losses.terms import direction_loss, focal_loss, forecast_losses, mask_loss
from predmapnet.training.losses.weights import LossWeights
from predmapnet.training.track_truth import TrackTruth


class LossSums:
    """Weighted sums of losses, and what each is divided by.

    Every process adds the same losses in the same order, found or not, so that counts can be averaged over processes:
    then N processes have the gradient of one that sees all of the batch.
    """

    def __init__(self) -> None:
        self._entries: list[tuple[str, Tensor, float]] = []

    def add(self, name: str, total: Tensor, count: float = 1.0) -> None:
        """Add a loss that is the mean over ``count`` things; several of one name are added up."""
        self._entries.append((name, total, count))

    def add_all(self, means: Mapping[str, Tensor]) -> None:
        """Add losses that are divided already."""
        for name, mean in means.items():
            self.add(name, mean)

    def means(self, shared: Callable[[Tensor], Tensor], processes: int = 1, scale: float = 1.0) -> dict[str, Tensor]:
        """Return the losses by name, times ``scale``; ``shared`` averages counts over all processes.

        Together these count one thing at least, so that what nobody found is divided by something.
        """
        sums = torch.stack([total for _, total, _ in self._entries])
        counts = shared(torch.tensor([count for _, _, count in self._entries], device=sums.device))
        shares = (scale * sums / counts.clamp(min=1 / processes)).unbind()
        terms: dict[str, Tensor] = {}
        for (name, _, _), term in zip(self._entries, shares, strict=True):
            terms[name] = terms[name] + term if name in terms else term
        return terms


def add_layers(
    sums: LossSums, outputs: FrameOutputs, truth: Truth, matched: Matched, tracks: int, weights: LossWeights
) -> None:
    """Add the losses of classes, lines and masks of all layers (L_track and L_seg); ``tracks`` rows are tracks."""
    for layer, pairs in zip(outputs.layers, matched.layers, strict=True):
        kinds = truth.targets.kinds[pairs.truth]
        if layer.logits is not None:
            wanted = torch.zeros_like(layer.logits)
            wanted[pairs.frame, pairs.row, kinds] = 1.0
            focal = (focal_loss(layer.logits, wanted) * outputs.query_valid[..., None]).sum()
            sums.add("focal", weights.focal * focal, len(pairs))
        if layer.points is not None:
            points = layer.points[pairs.frame, pairs.row] * truth.unit
            rings = kinds == ElementKind.PED_CROSSING
            target = best_order(points, truth.points[pairs.truth], rings, weights.cost_beta)
            apart = functional.smooth_l1_loss(points, target, reduction="sum", beta=weights.beta)
            sums.add("points", weights.points * apart / points.shape[1:].numel(), len(pairs))
            if weights.direction:
                sums.add("direction", weights.direction * direction_loss(points, target), len(pairs))
        if layer.masks is not None:
            drawn = truth.masks_like(layer.masks)[pairs.truth]
            loss = mask_loss(layer.masks[pairs.frame, pairs.row], drawn, weights)
            if layer.logits is None:
                # Layers of the generator that only draw refine detections: a track has one mask, in the last layer.
                loss = loss * (pairs.row >= tracks)
            sums.add("mask", loss.sum(), len(pairs))


def add_forecasts(
    sums: LossSums, forecasts: Tensor, owners: TrackTruth, coming: Truth, size: Tensor, weights: LossWeights
) -> None:
    """Add L_pred: distance of forecasts and truth of the next frame, mean over the tracks still seen there.

    An element may be cut into several pieces by the ROI; the one nearest to the forecast counts.

    Args:
        sums: is added to.
        forecasts, owners: ``(B, T, P, 2)``, normalised, and whom they are of.
        coming: truth of the next frame.
        size: ``(2,)``, length and width of the region, metres.
        weights: of the losses.
    """
    found: list[tuple[int, int, int, int]] = []
    tracks = 0
    for stream, (start, end) in enumerate(zip(coming.begin[:-1], coming.begin[1:], strict=True)):
        same = owners.pieces_of(stream, coming.kinds[start:end], coming.element_ids[start:end])
        for row in np.flatnonzero(same.any(axis=1)).tolist():
            found += [(stream, row, int(start) + piece, tracks) for piece in np.flatnonzero(same[row]).tolist()]
            tracks += 1
    index = torch.tensor(found, dtype=torch.int64).reshape(-1, 4).T.to(forecasts.device)
    stream_of, row_of, piece_of, track_of = index
    rings = coming.targets.kinds[piece_of] == ElementKind.PED_CROSSING
    truth = coming.targets.points[piece_of] * size
    loss = forecast_losses(forecasts[stream_of, row_of] * size, truth, rings, weights)
    nearest = loss.new_full((tracks,), torch.inf).scatter_reduce(0, track_of, loss, "amin")
    sums.add("forecast", nearest.sum(), tracks)
