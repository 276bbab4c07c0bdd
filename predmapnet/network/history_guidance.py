"""History-Map Guidance: track queries look again where they have been (Sec. 3.4)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from predmapnet.config import PredMapNetConfig
from predmapnet.network.layers import Attention, CellCode, flatten_cells, zero_init


class HistoryMapGuidance(nn.Module):
    """Cross-attention of each track query to the BEV cells of its history map.

    The branch is residual and starts as zero; a track without a valid cell keeps its query.
    """

    def __init__(self, config: PredMapNetConfig) -> None:
        super().__init__()
        width = config.decoder.width
        self.threshold = config.history_map.threshold
        self.input = nn.Linear(config.bev.widths[config.mask_level], width)
        self.cell_code = CellCode(width)
        self.class_code = nn.Embedding(config.decoder.classes, width)
        self.cross_attention = Attention(width, config.decoder.heads)
        zero_init(self.cross_attention.output)

    def forward(self, queries: Tensor, labels: Tensor, history_maps: Tensor, bev: Tensor) -> Tensor:
        """Refine track queries ``(B, T, C)`` (eq. 9).

        Args:
            queries: of the tracks.
            labels: ``(B, T) int64``.
            history_maps: ``(B, T, H_m, W_m)``, in the current ego frame.
            bev: ``(B, C_l, H_m, W_m)``, the BEV level of the masks' grid.
        """
        if queries.shape[1] == 0:
            return queries
        sampled = self.input(flatten_cells(bev)) + self.cell_code.of_grid(*bev.shape[-2:])
        valid = history_maps.detach().flatten(2) > self.threshold
        some = valid.any(dim=-1, keepdim=True)
        refined = self.cross_attention(queries + self.class_code(labels), sampled, sampled, valid | ~some)
        return torch.where(some, queries + refined, queries)
