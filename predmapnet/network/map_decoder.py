"""Interface of the map decoders: what they start from and what they return."""

from __future__ import annotations

from dataclasses import dataclass

import torch.nn.functional as F
from torch import Tensor, nn

from predmapnet.network.maptracker.vector_memory import RecalledQueries


@dataclass
class DecoderInput:
    """Start of the decoder; rows are ``T`` tracks, then ``Q`` detections.

    Attributes:
        queries: ``(B, T + Q, C)``.
        points: ``(B, T + Q, P, 2)``, normalised reference points.
        track_valid: ``(B, T) bool``; False for padding.
        memory: of the track rows; None for a decoder without.
        first_frame: ``(B) bool``, the stream has no past.
    """

    queries: Tensor
    points: Tensor
    track_valid: Tensor
    memory: RecalledQueries | None
    first_frame: Tensor

    @property
    def valid(self) -> Tensor:
        """``(B, T + Q) bool``: detections always are."""
        tracks, rows = self.track_valid.shape[1], self.queries.shape[1]
        return F.pad(self.track_valid, (0, rows - tracks), value=True)


class MapDecoder(nn.Module):
    """Base of the map decoders: from rows and the finest BEV level to polylines.

    Attributes:
        learns_start: gradient flows from the first layer into the reference points that it starts from; otherwise
            they need a loss of their own.
    """

    learns_start: bool

    def forward(self, start: DecoderInput, bev: Tensor) -> tuple[Tensor, list[tuple[Tensor, Tensor]]]:
        """Decode rows over the finest BEV level ``(B, C_0, H, W)``.

        Returns:
            Embeddings ``(B, T + Q, C)`` of the last layer, and of every layer the logits ``(B, T + Q, classes)`` and
            the normalised polylines ``(B, T + Q, P, 2)``.
        """
        raise NotImplementedError
