"""Memory of past BEV maps: what is kept and what is looked at."""

from dataclasses import replace

import torch

from predmapnet.network.small.residual_bev_memory import store_raw_map

SPACING = 2.0


def pose_at(x):
    pose = torch.eye(4, dtype=torch.float64)[None].clone()
    pose[:, 0, 3] = 5000.0 + x
    return pose


def drive(network, positions):
    """State after remembering, at each position, a map that is filled with the position."""
    state = network.initial_state(1)
    for x in positions:
        raw = torch.full((1, 4, 26, 52), float(x))
        maps, poses, valid = store_raw_map(state, raw, pose_at(x), SPACING)
        state = replace(state, bev_memory=maps, bev_memory_pose=poses, bev_memory_valid=valid)
    return state


def kept(state):
    return [float(m[0, 0, 0]) for m, v in zip(state.bev_memory[0], state.bev_memory_valid[0], strict=True) if v]


def test_maps_are_kept_in_order_and_the_oldest_is_dropped(network):
    assert kept(drive(network, [0, 3, 6])) == [0, 3, 6]
    assert kept(drive(network, [0, 3, 6, 9, 12, 15, 18])) == [6, 9, 12, 15, 18]


def test_standing_still_does_not_push_the_past_out(network):
    assert kept(drive(network, [0, 3, 6, *[6.1] * 20])) == [0, 3, 6, 6.099999904632568]


def test_for_each_distance_the_nearest_map_and_none_twice(network):
    state = drive(network, [0, 3, 8, 14, 17])
    chosen, valid = network.temporal_bev._choose(pose_at(18.0), state)
    # wanted 1, 5, 10 and 15 m back of 18: the maps at 17, 14, 8 and 3
    assert chosen[0].tolist() == [4, 3, 2, 1] and valid.all()
    chosen, valid = network.temporal_bev._choose(pose_at(1.0), drive(network, [0]))
    assert valid.tolist() == [[True, False, False, False]]


def test_what_is_looked_at_has_been_moved_with_the_car(network):
    state = network.initial_state(1)
    raw = torch.zeros(1, 4, 26, 52)
    raw[:, :, 12, 30] = 1.0
    cell = 60.0 / 52
    maps, poses, valid = store_raw_map(state, raw, pose_at(0.0), SPACING)
    state = replace(state, bev_memory=maps, bev_memory_pose=poses, bev_memory_valid=valid)
    past, reached = network.temporal_bev._look_back(pose_at(2 * cell), state)
    assert past[0, 0].argmax() == 12 * 52 + 28
    assert reached[0, 0, :, :49].min() > 0.99 and reached[0, 0, :, -1].max() < 0.01
    assert past[0, 4:].abs().max() == 0.0 and reached[0, 1:].abs().max() == 0.0
