"""A CPU that only infers samples rows of a table, and finds what training finds."""

import math
from dataclasses import replace

import torch

from predmapnet.network.small.decoder import sample_bev


def test_the_decoder_samples_the_same():
    torch.manual_seed(0)
    bev, positions = torch.randn(2, 16, 13, 26), torch.rand(2, 5, 6, 3, 2) * 1.4 - 0.2
    positions[0, 0, 0, 0] = torch.tensor([1e12, -1e12])
    expected = sample_bev(bev, positions)
    with torch.no_grad():
        found = sample_bev(bev, positions)
    torch.testing.assert_close(found, expected, atol=2e-5, rtol=0.0)


def test_what_is_no_number_stays_none_and_spoils_nothing_else():
    torch.manual_seed(0)
    bev, positions = torch.randn(1, 4, 13, 26), torch.rand(1, 2, 3, 2, 2)
    with torch.no_grad():
        expected = sample_bev(bev, positions)
        positions[0, 1, 2, 1] = math.nan
        found = sample_bev(bev, positions)
    assert found[0, 1, 2, 1].isnan().all()
    found[0, 1, 2, 1] = expected[0, 1, 2, 1]
    assert torch.equal(found, expected)


def test_past_maps_of_streams_that_turned_are_the_same(network):
    torch.manual_seed(0)
    state = network.initial_state(2)
    slots = state.bev_memory_valid.shape[1]
    yaw = torch.rand(2, slots, dtype=torch.float64)
    poses = torch.eye(4, dtype=torch.float64).expand(2, slots, 4, 4).clone()
    poses[..., 0, 0], poses[..., 0, 1], poses[..., 1, 0], poses[..., 1, 1] = yaw.cos(), -yaw.sin(), yaw.sin(), yaw.cos()
    poses[..., :2, 3] = 4e5 + 20 * torch.rand(2, slots, 2, dtype=torch.float64)
    valid = torch.arange(slots) >= torch.tensor([[slots - 2], [0]])
    maps = torch.randn_like(state.bev_memory)
    state = replace(state, bev_memory=maps, bev_memory_pose=poses, bev_memory_valid=valid)
    expected = network.temporal_bev._look_back(poses[:, -1], state)
    with torch.no_grad():
        found = network.temporal_bev._look_back(poses[:, -1], state)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, atol=3e-5, rtol=0.0)
