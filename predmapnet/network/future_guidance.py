"""Short-Term Future Guidance: where a track will be in the next ego frame, as a hint to its query (Sec. 3.5)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from mapfusion.elements import ElementKind
from predmapnet.config import PredMapNetConfig
from predmapnet.network.ego_motion import move_points
from predmapnet.network.layers import SINE_FREQUENCIES, Perceptron, sine_code, zero_init
from predmapnet.network.polylines import clip_polylines


class ShortTermFutureGuidance(nn.Module):
    """A perceptron over the last n polylines forecasts the next one; its embedding is fused into the query.

    Each polyline is given in the ego frame of its own instant, so the motion of the car shows in them; the motion of
    the next step is not known when the forecast is made. In the paper the perceptron guesses it from the polylines;
    with ``steady_motion`` the last step of the car is taken once more, and the perceptron only corrects that.
    """

    def __init__(self, config: PredMapNetConfig) -> None:
        super().__init__()
        width, points, histories = config.decoder.width, config.decoder.points, config.future.histories
        hidden = config.future.hidden
        self.steady_motion = config.future.steady_motion
        self.roi = config.roi
        self.offsets = Perceptron(histories * (2 * points + 1), hidden, hidden, 2 * points, zero_last=True)
        self.point_embedding = Perceptron(4 * SINE_FREQUENCIES, width, width)
        self.fusion = nn.Linear(2 * width, width)
        zero_init(self.fusion)

    def forecast(self, history: Tensor, valid: Tensor, labels: Tensor, last_step: Tensor) -> Tensor:
        """Predict the polylines ``(B, T, P, 2)``, normalised, in the ego frame of t + 1 (eq. 10).

        Args:
            history: ``(B, T, n, P, 2)``, normalised, oldest first, padded by the oldest one.
            valid: ``(B, T, n) bool``, False in padding.
            labels: ``(B, T) int64``.
            last_step: ``(B, 2, 3)``, metres: motion of the ground from the ego frame of t - 1 to that of t.
        """
        history = history.detach()  # What was seen must not be bent towards what is still to come.
        last = history[:, :, -1]
        motion = (history[:, :, :-1] - last[:, :, None]) * valid[:, :, :-1, None, None]
        seen = torch.cat([10.0 * motion.flatten(2), last.flatten(2) - 0.5, valid.to(last.dtype)], dim=-1)
        start = self._after_same_step(last, labels, last_step) if self.steady_motion else last
        return start + self.offsets(seen).unflatten(-1, last.shape[-2:]) / 10.0

    def _after_same_step(self, last: Tensor, labels: Tensor, step: Tensor) -> Tensor:
        """Move polylines as the last step of the car did; what leaves the ROI will not be seen."""
        if last.shape[1] == 0:
            return last
        size = last.new_tensor([self.roi.length, self.roi.width])
        moved = move_points(last, step, self.roi)
        return clip_polylines(moved, labels == ElementKind.PED_CROSSING, size)[0]

    def forward(self, queries: Tensor, forecasts: Tensor) -> Tensor:
        """Fuse the forecasts ``(B, T, P, 2)`` of this instant into the track queries ``(B, T, C)`` (eq. 11 and 12).

        The fusion is a linear layer of ``[query, PE_future]``, written as a residual that starts as zero.
        """
        future = self.point_embedding(sine_code(forecasts, SINE_FREQUENCIES)).mean(dim=2)
        return queries + self.fusion(torch.cat([queries, future], dim=-1))


def extend_history(
    history: Tensor, valid: Tensor, points: Tensor, source: Tensor, matched: Tensor
) -> tuple[Tensor, Tensor]:
    """Append this frame's polylines to the histories of their tracks.

    The order of a line's points carries no meaning and may turn round from one frame to the next; older polylines are
    turned with it, so that equal indices stand for about the same place.

    Args:
        history: ``(B, T, n, P, 2)`` of the former tracks, oldest first.
        valid: ``(B, T, n) bool``.
        points: ``(B, T', P, 2)``, of this frame.
        source: ``(B, T') int64``, which former track an instance continues.
        matched: ``(B, T') bool``, whether it continues one.

    Returns:
        Histories ``(B, T', n, P, 2)`` and their validity.
    """
    length = history.shape[2]
    fresh = points[:, :, None].expand(-1, -1, length, -1, -1)
    fresh_valid = torch.arange(length, device=points.device) == length - 1
    fresh_valid = fresh_valid.expand(*matched.shape, length)
    if history.shape[1] == 0:
        return fresh, fresh_valid
    stream = torch.arange(len(source), device=source.device)[:, None]
    old, old_valid = history[stream, source], valid[stream, source]
    as_is = (old[:, :, -1] - points).square().sum(dim=(-1, -2))
    turned = (old[:, :, -1].flip(-2) - points).square().sum(dim=(-1, -2))
    old = torch.where((turned < as_is)[..., None, None, None], old.flip(-2), old)
    shifted = torch.cat([old[:, :, 1:], points[:, :, None]], dim=2)
    shifted_valid = torch.cat([old_valid[:, :, 1:], torch.ones_like(old_valid[:, :, :1])], dim=2)
    # A history that is not full yet is padded by its oldest polyline, which moves one slot towards the front.
    oldest = shifted_valid.long().argmax(dim=2)
    slots = torch.maximum(torch.arange(length, device=points.device), oldest[..., None])
    padded = shifted.gather(2, slots[..., None, None].expand_as(shifted))
    return (
        torch.where(matched[..., None, None, None], padded, fresh),
        matched[..., None] & shifted_valid | ~matched[..., None] & fresh_valid,  # ONNX chooses no booleans.
    )
