"""History Rasterized Map Memory: what each track has looked like on the ground so far (Sec. 3.3)."""

from __future__ import annotations

import torch
from torch import Tensor

from mapfusion.elements import RegionOfInterest
from predmapnet.config import HistoryMapConfig
from predmapnet.network.ego_motion import warp_bev


class HistoryRasterMapMemory:
    """The rules of the memory; the maps themselves live in the stream's state. It has nothing to learn."""

    def __init__(self, config: HistoryMapConfig, roi: RegionOfInterest) -> None:
        self.beta = config.beta
        self.roi = roi

    def align(self, history_maps: Tensor, current_to_past: Tensor) -> Tensor:
        """Warp maps ``(B, T, H_m, W_m)`` by a motion ``(B, 2, 3)``, metres (eq. 6); zeros where the old ROI ended."""
        if history_maps.shape[1] == 0:
            return history_maps
        return warp_bev(history_maps, current_to_past, self.roi)

    def update(self, masks: Tensor, scores: Tensor, warped: Tensor, source: Tensor, matched: Tensor) -> Tensor:
        """Blend the masks of this frame into the maps (eq. 4) or begin new ones (eq. 5): ``(B, T', H_m, W_m)``, M^t.

        Tracks that have ended are not asked for and are so pruned.

        Args:
            masks: ``(B, T', H_m, W_m)``, probabilities of the instances that live on.
            scores: ``(B, T')``.
            warped: ``(B, T, H_m, W_m)``, maps of the former tracks in the current frame.
            source: ``(B, T') int64``, which former track an instance continues.
            matched: ``(B, T') bool``, whether it continues one.
        """
        weighted = masks * scores[..., None, None]
        if warped.shape[1] == 0:
            return weighted
        stream = torch.arange(len(source), device=source.device)[:, None]
        blended = (1 - self.beta) * warped[stream, source] + self.beta * weighted
        return torch.where(matched[..., None, None], blended, weighted)
