"""Motion perceptron: carries track queries from one ego frame to another (MapTracker's query propagation)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from predmapnet.network.ego_motion import quaternion

OCTAVES = 10
POSE_NUMBERS = 7
POSE_CODE = POSE_NUMBERS * (1 + 2 * OCTAVES)


class MotionMlp(nn.Module):
    """A residual perceptron of the query and of the motion."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.perceptron = nn.Sequential(
            nn.Linear(width + POSE_CODE, hidden), nn.LayerNorm(hidden), nn.ReLU(), nn.Linear(hidden, width)
        )

    def forward(self, queries: Tensor, pose: Tensor) -> Tensor:
        """Map queries ``(..., C)`` and pose vectors ``(..., 7)``, past to current, to queries ``(..., C)``."""
        return queries + self.perceptron(torch.cat([queries, motion_code(pose)], dim=-1))


def pose_vector(past_to_current: Tensor) -> Tensor:
    """Turn poses ``(..., 4, 4) float64`` into ``(..., 7) float32``: quaternion (x, y, z, w), then metres."""
    rounded = past_to_current.float()
    turn = quaternion(rounded[..., :3, :3].double()).float()
    return torch.cat([turn, rounded[..., :3, 3]], dim=-1)


def motion_code(pose: Tensor) -> Tensor:
    """Return ``(..., 147)``: the pose vector, then its sines and cosines, octave by octave."""
    octaves = 2.0 ** torch.arange(OCTAVES, device=pose.device, dtype=pose.dtype)
    angles = pose[..., None, :] * octaves[:, None]
    waves = torch.stack([angles.sin(), angles.cos()], dim=-2)
    return torch.cat([pose, waves.flatten(-3)], dim=-1)
