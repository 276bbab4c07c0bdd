"""Noise on the ego motion in training, so that tracks learn to find their element again (MapTracker's augmentation)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from predmapnet.network.ego_motion import relative_pose
from predmapnet.network.state import StreamState


def with_pose_noise(
    state: StreamState, ego_to_global: Tensor, angle: float, distance: float, generators: Sequence[torch.Generator]
) -> StreamState:
    """Return the state with poses that are wrong as seen from the current frame; maps of the BEV keep theirs.

    The last pose and that of each remembered frame are wrong by amounts of their own, the same for all tracks.

    Args:
        state: of the last frame.
        ego_to_global: ``(B, 4, 4) float64``, current.
        angle: deviation of each Euler angle, radians.
        distance: deviation of x and of y, metres.
        generators: of each stream, on the CPU.
    """
    memory = state.vector_memory
    frames = max(1, int(state.frame.max()))
    drawn = torch.stack([torch.randn(frames + 1, 5, generator=generator) for generator in generators])
    turn, shift = (angle * drawn[..., :3]).to(ego_to_global), (distance * drawn[..., 3:]).to(ego_to_global)

    def wrong(poses: Tensor, turn: Tensor, shift: Tensor, current: Tensor) -> Tensor:
        return (current @ disturb(relative_pose(poses, current), turn, shift)).to(poses.dtype)

    stream = torch.arange(len(ego_to_global), device=ego_to_global.device)[:, None, None]
    frame = memory.frames.clamp(0, frames - 1)
    return replace(
        state,
        ego_to_global=wrong(state.ego_to_global, turn[:, -1], shift[:, -1], ego_to_global),
        vector_memory=replace(
            memory,
            poses=wrong(memory.poses, turn[stream, frame], shift[stream, frame], ego_to_global[:, None, None]),
        ),
    )


def disturb(pose: Tensor, turn: Tensor, shift: Tensor) -> Tensor:
    """Add to the Euler angles and the place of poses.

    Args:
        pose: ``(..., 4, 4)``.
        turn: ``(..., 3)``, radians, about z, x and y, in this order about fixed axes.
        shift: ``(..., 2)``, metres, along x and y.
    """
    rotation = pose[..., :3, :3]
    about_z = torch.atan2(rotation[..., 1, 0], rotation[..., 1, 1])
    about_x = -torch.asin(rotation[..., 1, 2].clamp(-1.0, 1.0))
    about_y = torch.atan2(rotation[..., 0, 2], rotation[..., 2, 2])
    angles = torch.stack([about_z, about_x, about_y], dim=-1) + turn
    disturbed = pose.clone()
    disturbed[..., :3, :3] = rotation_of(angles)
    disturbed[..., :2, 3] += shift
    return disturbed


def rotation_of(angles: Tensor) -> Tensor:
    """Return the rotations ``(..., 3, 3)`` about z, then x, then y (fixed axes) by angles ``(..., 3)``, radians."""
    (sin_z, sin_x, sin_y), (cos_z, cos_x, cos_y) = angles.sin().unbind(-1), angles.cos().unbind(-1)
    rows = [
        torch.stack([cos_y * cos_z + sin_y * sin_x * sin_z, sin_y * sin_x * cos_z - cos_y * sin_z, sin_y * cos_x], -1),
        torch.stack([cos_x * sin_z, cos_x * cos_z, -sin_x], -1),
        torch.stack([cos_y * sin_x * sin_z - sin_y * cos_z, sin_y * sin_z + cos_y * sin_x * cos_z, cos_y * cos_x], -1),
    ]
    return torch.stack(rows, dim=-2)
