"""Noise of the ego motion turns and shifts what tracks store_queries, and nothing else."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from tiny_clips import tiny_paper_config

from predmapnet.network.ego_motion import relative_pose
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.training.pose_noise import disturb, rotation_of, with_pose_noise

ANGLES = st.tuples(*[st.floats(-1.4, 1.4)] * 3)


@settings(deadline=None, max_examples=50)
@given(ANGLES, ANGLES)
def test_angles_are_those_of_scipy_and_add_up(angles, turn):
    expected = Rotation.from_euler("zxy", angles).as_matrix()
    assert np.allclose(rotation_of(torch.tensor(angles, dtype=torch.float64)), expected)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.from_numpy(expected)
    pose[:3, 3] = torch.tensor([5.0, 6.0, 7.0])
    shift = torch.tensor([0.5, -0.25], dtype=torch.float64)
    found = disturb(pose, torch.tensor(turn, dtype=torch.float64), shift)
    assert np.allclose(found[:3, :3], Rotation.from_euler("zxy", np.add(angles, turn)).as_matrix())
    assert found[:3, 3].tolist() == [5.5, 5.75, 7.0]


@pytest.fixture(scope="module")
def state():
    """Two streams of two tracks, each remembered twice, after two frames."""
    empty = PredMapNet(tiny_paper_config()).initial_state(2)
    shape = (2, 2, 2)
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[:, 0, 3] = 1000.0
    memory = type(empty.vector_memory)(
        queries=torch.zeros(*shape, 4),
        poses=poses[:, None, None].repeat(1, 2, 2, 1, 1),
        frames=torch.arange(2).expand(shape),
        valid=torch.ones(shape, dtype=torch.bool),
    )
    empty.ego_to_global, empty.vector_memory, empty.frame = poses, memory, torch.full((2,), 2)
    return empty


def test_noise_is_one_per_frame_and_leaves_the_height(state):
    now = state.ego_to_global.clone()
    now[:, 0, 3] += 2.0
    noisy = with_pose_noise(state, now, 0.1, 0.3, [torch.Generator().manual_seed(seed) for seed in (1, 2)])
    moved = relative_pose(noisy.ego_to_global, now)
    assert (moved[:, 0, 3] + 2.0).abs().max() < 2.0
    assert not torch.allclose(moved[0], moved[1])
    assert torch.allclose(moved[:, 2, 3], torch.zeros(2, dtype=torch.float64))
    remembered = relative_pose(noisy.vector_memory.poses, now[:, None, None])
    assert torch.allclose(remembered[:, 0], remembered[:, 1])
    assert not torch.allclose(remembered[:, :, 0], remembered[:, :, 1])
    assert noisy.bev_memory_pose is state.bev_memory_pose


def test_no_noise_is_no_change(state):
    now = state.ego_to_global.clone()
    now[:, 1, 3] -= 3.0
    same = with_pose_noise(state, now, 0.0, 0.0, [torch.Generator()] * 2)
    assert torch.allclose(same.ego_to_global, state.ego_to_global)
    assert torch.allclose(same.vector_memory.poses, state.vector_memory.poses)
