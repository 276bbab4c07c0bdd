"""The paper's modules at sizes for tests, with every branch open, and frames that begin at the BEV features."""

import copy
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import torch
from torch import Tensor, nn

from predmapnet.config import PredMapNetConfig
from predmapnet.network.calibration import Calibration
from predmapnet.network.layers import Attention
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.network.state import BevFeatures, FrameInputs, FrameOutputs, Instances, StreamState
from predmapnet.network.track_selection import instances_from_rows
from predmapnet.presets import parse_config
from tests.predmapnet.small_networks import Sections, opened, small_config

SIZES = ("paper", "lite")


def tiny_config(size: str, **sections: Sections) -> PredMapNetConfig:
    """Return ``paper-nuscenes`` or ``lite`` made small; keyword arguments change sections further."""
    return small_config("paper-nuscenes" if size == "paper" else "lite", **sections)


def tiny_network(size: str, **sections: Sections) -> PredMapNet:
    """Return an open network without its image backbone, which takes most of the time and is not asked for here."""
    return copy.deepcopy(_built(tiny_config(size, **sections).to_json()))


@cache
def _built(config: str) -> PredMapNet:
    torch.manual_seed(0)
    network = PredMapNet(parse_config(config, "test"))
    network.image_backbone = nn.Identity()
    return opened(network)


def bev_levels(config: PredMapNetConfig, batch: int = 1, seed: int = 0) -> list[Tensor]:
    """Return random BEV features, fine to coarse."""
    generator = torch.Generator().manual_seed(seed)
    rows, columns = config.bev.rows, config.bev.columns
    sizes = [(-(-rows // scale), -(-columns // scale)) for scale in (1, 2, 4)]
    return [torch.randn(batch, w, *s, generator=generator) for w, s in zip(config.bev.widths, sizes, strict=True)]


def pose(x: float = 0.0, y: float = 0.0, yaw: float = 0.0) -> Tensor:
    """Return an ego pose ``(1, 4, 4)`` far from the origin of the map."""
    matrix = torch.eye(4, dtype=torch.float64)[None]
    matrix[0, 0, :2] = torch.tensor([math.cos(yaw), -math.sin(yaw)])
    matrix[0, 1, :2] = torch.tensor([math.sin(yaw), math.cos(yaw)])
    matrix[0, :2, 3] = torch.tensor([1000.0 + x, -500.0 + y], dtype=torch.float64)
    return matrix


def frame(ego_to_global: Tensor) -> FrameInputs:
    """Return a frame of which only the pose is known: its BEV features are given."""
    batch = len(ego_to_global)
    return FrameInputs(
        torch.zeros(batch, 0), torch.zeros(batch, 0, dtype=torch.bool), ego_to_global, Calibration.empty(batch)
    )


def decode(
    network: PredMapNet, levels: list[Tensor], ego_to_global: Tensor, state: StreamState | None = None
) -> FrameOutputs:
    return network.decode_bev(BevFeatures(levels), frame(ego_to_global), state)


def keep(outputs: FrameOutputs, rows: Sequence[int], ids: Sequence[int]) -> Instances:
    """Let rows of the only stream live on under the given ids."""
    chosen = torch.tensor([rows])
    return instances_from_rows(outputs, chosen, chosen >= 0, torch.tensor([ids]))


def advance(network: PredMapNet, state: StreamState | None, outputs: FrameOutputs, kept: Instances) -> StreamState:
    return network.advance(state, outputs, kept, frame(outputs.ego_to_global))


def one_frame_later(network: PredMapNet, tracks: int = 3, seed: int = 0, **changes: Any) -> StreamState:
    """Return the state after a first frame at ``pose()`` whose last detections became tracks 0, 1, ..."""
    outputs = decode(network, bev_levels(network.config, seed=seed), pose())
    last = outputs.query_valid.shape[1]
    kept = keep(outputs, range(last - tracks, last), range(tracks))
    return replace(advance(network, None, outputs, kept), **changes)


def attention_by_hand(part: Attention, query: Tensor, key: Tensor, value: Tensor, allowed: Tensor) -> Tensor:
    """Attention of ``(R, C)`` to the ``allowed (R, S)`` of ``(S, C)``, one head and one row after the other."""
    q, k, v = part.query(query), part.key(key), part.value(value)
    width = q.shape[1] // part.heads
    heads = []
    for head in range(part.heads):
        of_head = slice(head * width, (head + 1) * width)
        rows = []
        for row in range(len(query)):
            cells = allowed[row].nonzero()[:, 0]
            scores = k[cells, of_head] @ q[row, of_head] / math.sqrt(width)
            share = scores.exp() / scores.exp().sum()
            rows.append(share @ v[cells, of_head])
        heads.append(torch.stack(rows))
    found: Tensor = part.output(torch.cat(heads, dim=1))
    return found


def place_code(x: float, y: float) -> Tensor:
    """Code of a place, normalised over the region: sines of six octaves of x, of y, then the cosines."""
    angles = [math.pi * 2**octave * place for place in (x, y) for octave in range(6)]
    return torch.tensor([math.sin(angle) for angle in angles] + [math.cos(angle) for angle in angles])


def cell_codes(rows: int, columns: int) -> Tensor:
    """Codes ``(rows * columns, 24)`` of the centres of all cells; the first row lies at the largest y."""
    places = [((c + 0.5) / columns, 1 - (r + 0.5) / rows) for r in range(rows) for c in range(columns)]
    return torch.stack([place_code(*place) for place in places])
