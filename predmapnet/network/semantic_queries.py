"""Semantic-Aware Query Generator: detection queries that know the scene before they are decoded (Sec. 3.2)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from predmapnet.config import PointDecoderConfig, PredMapNetConfig
from predmapnet.network.instance_masks import MaskHead, attention_cells
from predmapnet.network.layers import Attention, CellCode, FeedForward, Perceptron, flatten_cells


@dataclass
class GeneratedQueries:
    """Detection queries of one instant.

    Attributes:
        queries: ``(B, Q, C)``, Q^SA of layer L.
        points: ``(B, Q, P, 2)``, first guess of the polylines, normalised.
        logits: ``(B, Q, 3)`` before the first and after each layer; none of a generator that names no classes.
        masks: ``(B, Q, H_m, W_m)`` logits before the first and after each layer.
    """

    queries: Tensor
    points: Tensor
    logits: list[Tensor]
    masks: list[Tensor]


class MaskedAttentionLayer(nn.Module):
    """Masked cross-attention (eq. 2 and 3), then self-attention and feed-forward as in Mask2Former."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.cross_attention = Attention(width, heads)
        self.cross_norm = nn.LayerNorm(width)
        self.self_attention = Attention(width, heads)
        self.self_norm = nn.LayerNorm(width)
        self.feed_forward = FeedForward(width, 2 * width)

    def forward(self, queries: Tensor, position: Tensor, tokens: Tensor, token_code: Tensor, allowed: Tensor) -> Tensor:
        """Refine queries ``(B, Q, C)``.

        Args:
            queries: of the layer before.
            position: ``(Q, C)``, learned, added to queries and keys of attention.
            tokens: ``(B, S, C)``, BEV features of one level.
            token_code: ``(S, C)``, where these cells are.
            allowed: ``(B, Q, S) bool``.
        """
        attended = self.cross_attention(queries + position, tokens + token_code, tokens, allowed)
        queries = self.cross_norm(queries + attended)
        placed = queries + position
        queries = self.self_norm(queries + self.self_attention(placed, placed, queries))
        return self.feed_forward(queries)


class SemanticAwareQueryGenerator(nn.Module):
    """Learned queries, refined by L layers of masked attention over the BEV levels, coarse to fine, round robin.

    Its masks know no classes. Only the lighter decoder, whose training assigns the truth to each layer of the generator
    anew, needs their names for that. Switched off, the learned queries go to the decoder as they are (the random
    initialisation of the baselines).
    """

    def __init__(self, config: PredMapNetConfig) -> None:
        super().__init__()
        decoder = config.decoder
        self.enabled = config.semantic_queries.enabled
        self.threshold = config.semantic_queries.mask_threshold
        self.points = decoder.points
        self.content = nn.Parameter(torch.randn(decoder.queries, decoder.width))
        hidden = [decoder.width] if isinstance(decoder, PointDecoderConfig) else []
        self.first_guess = Perceptron(decoder.width, *hidden, 2 * decoder.points)
        if not self.enabled:
            return
        self.position = nn.Parameter(torch.randn(decoder.queries, decoder.width))
        count = config.semantic_queries.layers
        self.layers = nn.ModuleList(MaskedAttentionLayer(decoder.width, decoder.heads) for _ in range(count))
        self.level_inputs = nn.ModuleList(nn.Linear(width, decoder.width) for width in config.bev.widths[::-1][:count])
        self.cell_code = CellCode(decoder.width)
        self.classify = nn.Linear(decoder.width, decoder.classes) if isinstance(decoder, PointDecoderConfig) else None
        if self.classify is not None:
            nn.init.constant_(self.classify.bias, -3.0)

    def forward(
        self, levels: list[Tensor], mask_features: Tensor | None, mask_head: MaskHead | None
    ) -> GeneratedQueries:
        """Generate the detection queries of one instant.

        Args:
            levels: BEV features ``(B, C_l, h_l, w_l)``, coarse to fine; switched off, their number does not matter.
            mask_features: ``(B, C_m, H_m, W_m)``; None if the generator is switched off.
            mask_head: shared with the tracks.
        """
        queries = self.content.expand(len(levels[0]), -1, -1)
        logits: list[Tensor] = []
        masks: list[Tensor] = []
        if self.enabled:
            assert mask_features is not None and mask_head is not None
            logits, masks = self._names(queries), [mask_head(queries, mask_features)]
            inputs = [linear(flatten_cells(level)) for linear, level in zip(self.level_inputs, levels, strict=False)]
            for number, layer in enumerate(self.layers):
                turn = number % len(inputs)
                rows, columns = levels[turn].shape[-2:]
                code = self.cell_code.of_grid(rows, columns)
                allowed = attention_cells(masks[-1].detach(), (rows, columns), self.threshold)
                queries = layer(queries, self.position, inputs[turn], code, allowed)
                logits += self._names(queries)
                masks.append(mask_head(queries, mask_features))
        points = self.first_guess(queries).sigmoid().unflatten(-1, (self.points, 2))
        return GeneratedQueries(queries, points, logits, masks)

    def _names(self, queries: Tensor) -> list[Tensor]:
        return [] if self.classify is None else [self.classify(queries)]
