"""Assignment of predictions to truth: Hungarian, over every equivalent order of the points.

Costs of all layers and streams of an instant go to the host together, so that a GPU waits once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor
from torch.nn import functional

from mapfusion.arrays import Bool, Float32, Integer
from mapfusion.elements import ElementKind
from predmapnet.network.state import FrameOutputs, LayerPredictions
from predmapnet.training.data.targets import Targets, equivalent_orders
from predmapnet.training.losses.weights import LossWeights
from predmapnet.training.track_truth import TrackTruth

FOCAL_ALPHA, FOCAL_GAMMA = 0.25, 2.0
WORST = 1e9
"""Cost of what cannot be told, so that an assignment exists even where a loss is not a number."""


@dataclass
class Assignment:
    """Pairs of a prediction's row and a piece of truth.

    Attributes:
        frame: ``(n,) int64``, index in the batch.
        row: ``(n,) int64``, row of the layer's predictions.
        truth: ``(n,) int64``, index into the flattened targets.
    """

    frame: Tensor
    row: Tensor
    truth: Tensor

    def __len__(self) -> int:
        return len(self.row)


class Truth:
    """Truth of one instant of ``B`` streams: on the host to be assigned, on the device to be compared.

    Attributes:
        targets: on the device.
        kinds, element_ids: ``(M,)``, on the host.
        begin: ``(B + 1,)``, on the host: pieces ``begin[b]`` to ``begin[b + 1]`` are those of stream b.
        pieces: ``(B, G) int64``, on the device: the pieces of each stream; anything in padding.
        unit: ``(2,)``, what one stands for, in the unit of the losses.
        points: ``(M, P, 2)``, in that unit.
    """

    def __init__(self, targets: Targets, device: torch.device, unit: Tensor) -> None:
        """Take targets that are on the host."""
        self.unit = unit
        self.kinds, self.element_ids = targets.kinds.numpy(), targets.element_ids.numpy()
        counts = np.bincount(targets.frame.numpy(), minlength=targets.batch)
        self.begin = np.concatenate([[0], np.cumsum(counts)])
        self.targets = targets.to(device)
        self.points = self.targets.points * unit
        at = np.minimum(self.begin[:-1, None] + np.arange(counts.max(initial=0)), max(len(self.kinds) - 1, 0))
        self.pieces = torch.from_numpy(at).to(device)
        self._masks: Tensor | None = None

    def masks_like(self, like: Tensor) -> Tensor:
        """Return the drawn masks ``(M, H, W)`` at the size of a layer's; a cell is set if any of its cells was."""
        if self._masks is None or self._masks.shape[-2:] != like.shape[-2:]:
            drawn = self.targets.masks
            pooled = functional.adaptive_max_pool2d(drawn[None], like.shape[-2:])[0] if len(drawn) else drawn
            self._masks = pooled.reshape(len(drawn), *like.shape[-2:])
        return self._masks

    def orders(self) -> tuple[Tensor, Tensor, int]:
        """List every order of the points of each piece: two of a line, and every start and direction of a ring.

        Returns:
            Lines ``(B, K, 2 P)``, stream by stream; the number ``(B, K)`` of their piece within its stream, in padding
            that of none; and how many pieces a stream has at most.
        """
        line, ring = (table.numpy() for table in equivalent_orders(self.points.shape[1]))
        is_ring = self.kinds == ElementKind.PED_CROSSING
        counts, most = np.where(is_ring, len(ring), len(line)), int(np.diff(self.begin).max(initial=0))
        streams = [np.arange(start, end) for start, end in zip(self.begin[:-1], self.begin[1:], strict=True)]
        longest = max((int(counts[pieces].sum()) for pieces in streams), default=0)
        piece, owner = np.zeros((len(streams), longest), np.int64), np.full((len(streams), longest), most)
        index = np.zeros((len(streams), longest, self.points.shape[1]), np.int64)
        for number, pieces in enumerate(streams):
            if len(pieces):
                of_piece = np.repeat(pieces, counts[pieces])
                piece[number, : len(of_piece)], owner[number, : len(of_piece)] = of_piece, of_piece - pieces[0]
                index[number, : len(of_piece)] = np.concatenate([ring if is_ring[at] else line for at in pieces])
        device = self.points.device
        where = torch.from_numpy(piece[..., None]).to(device), torch.from_numpy(index).to(device)
        lines = self.points[where] if len(self.points) else self.points.new_zeros(*index.shape, 2)
        return lines.flatten(2), torch.from_numpy(owner).to(device), most


def line_costs(lines: Tensor, orders: Tensor, owner: Tensor, pieces: int, beta: float) -> Tensor:
    """Distance of lines to each piece under its best order, mean over the coordinates.

    Args:
        lines: ``(B, R, 2 P)``, in the unit of the orders.
        orders, owner, pieces: of :meth:`Truth.orders`.
        beta: of a smooth L1 distance; 0 is a plain one.

    Returns:
        ``(B, R, G)``.
    """
    if beta:
        found, wanted = torch.broadcast_tensors(lines[:, :, None], orders[:, None])
        distance = functional.smooth_l1_loss(found, wanted, reduction="none", beta=beta).mean(dim=-1)
    else:
        distance = torch.cdist(lines, orders, p=1) / lines.shape[-1]
    best = distance.new_full((*lines.shape[:2], pieces + 1), torch.inf)
    return best.scatter_reduce(2, owner[:, None].expand_as(distance), distance, "amin")[..., :pieces]


def best_order(points: Tensor, targets: Tensor, rings: Tensor, beta: float = 0.0) -> Tensor:
    """Put each target into the equivalent order that is nearest to its prediction.

    Args:
        points: ``(n, P, 2)``, predictions.
        targets: ``(n, P, 2)``, one for each prediction.
        rings: ``(n,) bool``, closed polylines.
        beta: as for :func:`line_costs`.
    """
    line, ring = (table.to(targets.device) for table in equivalent_orders(targets.shape[1]))
    table = torch.where(rings[:, None, None], ring, line.repeat(len(ring) // 2, 1))
    which = torch.arange(len(targets), device=targets.device)
    orders = targets[which[:, None, None], table]
    found = points.detach()[:, None].expand_as(orders)
    distance = functional.smooth_l1_loss(found, orders, reduction="none", beta=beta)
    return orders[which, distance.sum((2, 3)).argmin(1)]


def focal_class_cost(logits: Tensor) -> Tensor:
    """Focal loss of a row being each class, less that of being background; ``(..., classes)``, as the logits."""
    probability = logits.sigmoid()
    positive = -FOCAL_ALPHA * (1 - probability) ** FOCAL_GAMMA * functional.logsigmoid(logits)
    negative = -(1 - FOCAL_ALPHA) * probability**FOCAL_GAMMA * functional.logsigmoid(-logits)
    return positive - negative


def mask_cost(logits: Tensor, masks: Tensor) -> Tensor:
    """Dice loss plus binary cross-entropy of every mask with every target mask.

    Args:
        logits: ``(B, n, H, W)``.
        masks: ``(B, m, H, W)`` in [0, 1].

    Returns:
        ``(B, n, m)``.
    """
    logits, drawn = logits.flatten(2), masks.flatten(2).transpose(1, 2)
    entropy = (functional.softplus(-logits) @ drawn + functional.softplus(logits) @ (1 - drawn)) / logits.shape[2]
    probability = logits.sigmoid()
    overlap = 2 * probability @ drawn + 1
    return 1 - overlap / (probability.sum(2)[..., None] + drawn.sum(1)[:, None] + 1) + entropy


@dataclass
class Matched:
    """Assignment of queries to the truth in one instant.

    Attributes:
        layers: pairs of each layer, tracks included; a layer that does not classify has those of the last one.
        truth: ``(B, R) int64``, on the host: what each row answers for in the last layer, or -1.
        scores: ``(B, R)``, on the host, of the last layer.
        valid: ``(B, R) bool``, on the host: rows that are not padding.
    """

    layers: list[Assignment]
    truth: Integer
    scores: Float32
    valid: Bool


@torch.no_grad()
def match(outputs: FrameOutputs, truth: Truth, owners: TrackTruth, weights: LossWeights, exclusive: bool) -> Matched:
    """Assign the rows of every layer to the truth of their stream.

    A track answers for the piece that it stands for already, or for background if that is gone. Detections share out
    all of the truth, or what tracks leave of it.

    Args:
        outputs: rows are tracks, then detections.
        truth: of the instant.
        owners: of the tracks.
        weights: of the costs.
        exclusive: detections do not see the truth that tracks answer for (``suppress``), and no two tracks answer for
            one piece.
    """
    orders, tracks = truth.orders(), owners.kinds.shape[1]
    deciding = [layer for layer in outputs.layers if layer.logits is not None]
    last = deciding[-1]
    assert last.logits is not None and last.points is not None and last is outputs.layers[-1]
    distance = line_costs((last.points[:, :tracks] * truth.unit).flatten(2), *orders, 0.0)
    scores = last.logits.sigmoid().amax(dim=2)
    costs = [_layer_costs(layer, truth, orders, weights) for layer in deciding]
    on_host = _to_host([*costs, distance, scores, outputs.query_valid])
    apart, score, valid = on_host[-3], on_host[-2], on_host[-1] > 0
    pairs: list[list[Integer]] = [[] for _ in deciding]
    for stream, (start, end) in enumerate(zip(truth.begin[:-1], truth.begin[1:], strict=True)):
        pieces = slice(start, end)
        offered = np.arange(end - start)
        own = truth.kinds[pieces], truth.element_ids[pieces], apart[stream][:, offered]
        kept, kept_pieces = owners.pieces_in_sight(stream, valid[stream, :tracks], *own, exclusive)
        free = tracks + np.flatnonzero(valid[stream, tracks:])
        if exclusive:
            offered = np.setdiff1d(offered, kept_pieces)
        for cost, found in zip(on_host[:-3], pairs, strict=True):
            rows, chosen = assign(cost[stream], free, offered)
            rows, chosen = np.concatenate([kept, rows]), np.concatenate([kept_pieces, chosen])
            order = np.argsort(rows, kind="stable")
            found.append(np.stack([np.full(len(rows), stream), rows[order], chosen[order] + start]))
    joined = [np.concatenate(found, axis=1) for found in pairs]
    answers = np.full(valid.shape, -1)
    answers[joined[-1][0], joined[-1][1]] = joined[-1][2]
    together = torch.from_numpy(np.concatenate(joined, axis=1)).to(scores.device)
    parts = together.split([each.shape[1] for each in joined], 1)
    by_layer = {id(layer): Assignment(*three) for layer, three in zip(deciding, parts, strict=True)}
    layers = [by_layer.get(id(layer), by_layer[id(last)]) for layer in outputs.layers]
    return Matched(layers, answers, score, valid)


def assign(cost: Float32, rows: Integer, pieces: Integer) -> tuple[Integer, Integer]:
    """Return the cheapest pairs of some rows and some pieces of a cost ``(R, G)``; as many as the fewer of both."""
    part = np.nan_to_num(cost[np.ix_(rows, pieces)], nan=WORST, posinf=WORST, neginf=-WORST)
    chosen, answered = linear_sum_assignment(part)
    return rows[chosen], pieces[answered]


def _layer_costs(
    layer: LayerPredictions, truth: Truth, orders: tuple[Tensor, Tensor, int], weights: LossWeights
) -> Tensor:
    """Costs ``(B, R, G)`` of one layer; anything in padding."""
    assert layer.logits is not None
    kinds = truth.targets.kinds[truth.pieces] if len(truth.kinds) else truth.pieces
    of_class = focal_class_cost(layer.logits)
    cost = weights.cost_focal * of_class.gather(2, kinds[:, None].expand(-1, of_class.shape[1], -1))
    if layer.points is not None:
        return cost + weights.cost_points * line_costs(
            (layer.points * truth.unit).flatten(2), *orders, weights.cost_beta
        )
    if layer.masks is not None and len(truth.kinds):
        return cost + weights.cost_mask * mask_cost(layer.masks, truth.masks_like(layer.masks)[truth.pieces])
    return cost


def _to_host(tensors: Sequence[Tensor]) -> list[Float32]:
    """Bring tensors to the host in one go."""
    flat = torch.cat([tensor.flatten().float() for tensor in tensors]).cpu().numpy()
    parts = np.split(flat, np.cumsum([tensor.numel() for tensor in tensors])[:-1])
    return [part.reshape(tensor.shape) for part, tensor in zip(parts, tensors, strict=True)]
