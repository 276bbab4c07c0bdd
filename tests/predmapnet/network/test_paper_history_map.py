"""History maps: their memory (Sec. 3.3, equations 4 to 6) and their guidance (Sec. 3.4, equations 7 to 9)."""

import math
from dataclasses import replace

import pytest
import torch

from predmapnet.network.history_guidance import HistoryMapGuidance
from tests.predmapnet.network.paper_network import (
    SIZES,
    advance,
    attention_by_hand,
    bev_levels,
    cell_codes,
    decode,
    keep,
    one_frame_later,
    opened,
    pose,
    tiny_config,
    tiny_network,
)

pytestmark = [pytest.mark.usefixtures("one_thread"), pytest.mark.parametrize("size", SIZES)]

MOVES = [(6.0, 0.0, 0.0), (-6.0, 3.0, 0.0), (0.0, -4.5, 0.0), (4.0, 2.0, 0.5), (0.0, 0.0, -0.4)]


def seen_after(move, x, y):
    """Where a place of the ego frame at ``pose()`` lies once the car has moved."""
    dx, dy, yaw = move
    cos, sin = math.cos(yaw), math.sin(yaw)
    return cos * (x - dx) + sin * (y - dy), -sin * (x - dx) + cos * (y - dy)


def painted(network, tracks=3, value=0.95):
    """Maps with a blob of 3 x 3 cells ahead on the left."""
    rows, columns = network.config.mask_size
    maps = torch.zeros(1, tracks, rows, columns)
    maps[:, :, rows // 5 : rows // 5 + 3, 13 * columns // 20 : 13 * columns // 20 + 3] = value
    return maps


def centre(network, maps):
    """Centre of what a map ``(H, W)`` shows, metres."""
    (rows, columns), config = maps.shape, network.config
    y = (0.5 - (torch.arange(rows) + 0.5) / rows) * config.roi_width
    x = ((torch.arange(columns) + 0.5) / columns - 0.5) * config.roi_length
    share = maps / maps.sum()
    return float((share.sum(dim=0) * x).sum()), float((share.sum(dim=1) * y).sum())


@pytest.mark.parametrize("move", MOVES)
@torch.no_grad()
def test_a_painted_history_map_stays_on_the_ground_while_the_car_moves(size, move):
    network = tiny_network(size)
    maps = painted(network)
    state = one_frame_later(network, history_maps=maps)
    outputs = decode(network, bev_levels(network.config), pose(*move), state)
    expected = seen_after(move, *centre(network, maps[0, 0]))
    assert centre(network, outputs.warped_history[0, 0]) == pytest.approx(expected, abs=0.3)
    kept = keep(outputs, [0, 1], [0, 1])
    after = advance(network, state, outputs, replace(kept, masks=torch.zeros_like(kept.masks)))
    assert centre(network, after.history_maps[0, 1]) == pytest.approx(expected, abs=0.3)


@torch.no_grad()
def test_guidance_sees_the_map_where_it_lies_now(size):
    """What the car has left behind guides nobody; what was ahead does."""
    network = tiny_network(size)
    state = one_frame_later(network)
    nothing, behind = torch.zeros_like(state.history_maps), torch.zeros_like(state.history_maps)
    behind[..., :4] = 1.0
    levels, later = bev_levels(network.config, seed=1), pose(16.0)

    def queries(maps):
        return decode(network, levels, later, replace(state, history_maps=maps)).queries

    torch.testing.assert_close(queries(behind), queries(nothing))
    assert (queries(behind.flip(-1)) - queries(nothing)).abs().max() > 1e-3


@torch.no_grad()
def test_ground_that_the_old_region_did_not_reach_is_empty(size):
    network = tiny_network(size)
    state = one_frame_later(network)
    state = replace(state, history_maps=torch.ones_like(state.history_maps))
    warped = decode(network, bev_levels(network.config), pose(18.0), state).warped_history
    columns = network.config.mask_size[1]
    assert warped[..., -(3 * columns // 10 - 1) :].abs().max() == 0.0
    assert warped[..., 2:-2, : columns // 2].min() > 0.99


@pytest.mark.parametrize("beta", [0.9, 0.3])
@torch.no_grad()
def test_maps_follow_their_tracks_and_end_with_them(size, beta):
    """Eq. 4 for tracks that live on, Eq. 5 for newborn ones, and no map of those that ended."""
    network = tiny_network(size, history_map={"beta": beta})
    state = one_frame_later(network)
    maps = torch.tensor([0.2, 0.5, 0.8])[None, :, None, None].expand_as(state.history_maps)
    state = replace(state, history_maps=maps.clone())
    outputs = decode(network, bev_levels(network.config, seed=1), pose(), state)
    newborn = outputs.query_valid.shape[1] - 1
    kept = keep(outputs, [2, newborn, 0], [2, 7, 0])
    kept = replace(kept, scores=torch.tensor([[0.9, 0.6, 0.7]]))
    history = advance(network, state, outputs, kept).history_maps
    assert history.shape[1] == 3
    warped, seen = outputs.warped_history[0], kept.masks[0]
    assert seen.min() >= 0.0 and seen.max() <= 1.0, "probabilities"
    torch.testing.assert_close(history[0, 0], (1 - beta) * warped[2] + beta * 0.9 * seen[0])
    torch.testing.assert_close(history[0, 1], 0.6 * seen[1])
    torch.testing.assert_close(history[0, 2], (1 - beta) * warped[0] + beta * 0.7 * seen[2])


@torch.no_grad()
def test_a_first_map_is_the_mask_weighted_by_its_score(size):
    network = tiny_network(size)
    outputs = decode(network, bev_levels(network.config), pose())
    kept = keep(outputs, [1, 3], [0, 1])
    history = advance(network, None, outputs, kept).history_maps
    torch.testing.assert_close(history, kept.masks * kept.scores[..., None, None])
    assert (kept.scores < 1.0).all()


def guidance_case(size, **sections):
    config = tiny_config(size, **sections)
    torch.manual_seed(0)
    guidance = opened(HistoryMapGuidance(config))
    generator = torch.Generator().manual_seed(1)
    queries = torch.randn(1, 3, config.decoder.width, generator=generator)
    maps = torch.rand(1, 3, *config.mask_size, generator=generator)
    maps[:, 2] = 0.5  # Nowhere above theta.
    return guidance, queries, torch.tensor([[0, 2, 1]]), maps, bev_levels(config)[config.mask_level]


@torch.no_grad()
def test_guidance_is_attention_to_the_cells_above_theta_with_place_and_class(size):
    """Eq. 7 to 9, one track and one cell after the other."""
    guidance, queries, labels, maps, bev = guidance_case(size)
    rows, columns = bev.shape[-2:]
    sampled = guidance.input(bev[0].flatten(1).T) + guidance.cell_code(cell_codes(rows, columns))
    found = guidance(queries, labels, maps, bev)[0]
    asked = queries[0] + guidance.class_code.weight[labels[0]]
    valid = maps[0].flatten(1) > 0.5
    refined = attention_by_hand(guidance.cross_attention, asked[:2], sampled, sampled, valid[:2])
    torch.testing.assert_close(found[:2], queries[0, :2] + refined, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(found[2], queries[0, 2])


@torch.no_grad()
def test_cells_below_theta_do_not_change_a_track_and_cells_above_do(size):
    for theta in (0.5, 0.8):
        guidance, queries, labels, maps, bev = guidance_case(size, history_map={"threshold": theta})
        before = guidance(queries, labels, maps, bev)
        valid = maps[0, 0] > theta
        for where, matters in ((~valid, False), (valid, True)):
            changed = bev.clone()
            changed[:, :, where] += 5.0
            difference = (guidance(queries, labels, maps, changed) - before)[0, 0].abs().max()
            assert bool(difference > 1e-3) == matters


@torch.no_grad()
def test_each_track_looks_at_its_own_map_only(size):
    guidance, queries, labels, maps, bev = guidance_case(size)
    before = guidance(queries, labels, maps, bev)
    other = maps.clone()
    other[:, 1] = maps[:, 1].flip(-1)
    after = guidance(queries, labels, other, bev)
    assert torch.equal(before[:, 0], after[:, 0]) and torch.equal(before[:, 2], after[:, 2])
    assert (before[:, 1] - after[:, 1]).abs().max() > 1e-3


@torch.no_grad()
def test_a_track_knows_its_class_and_the_network_tells_it(size):
    network = tiny_network(size)
    state = one_frame_later(network)
    state = replace(state, history_maps=painted(network))
    levels, found = bev_levels(network.config, seed=1), []
    for label in (0, 1, 2):
        labelled = replace(state, instances=replace(state.instances, labels=torch.full((1, 3), label)))
        found.append(decode(network, levels, pose(1.0), labelled).queries[:, :3])
    for one, other in ((0, 1), (1, 2), (0, 2)):
        assert (found[one] - found[other]).abs().max() > 1e-3


@torch.no_grad()
def test_the_memory_keeps_the_masks_of_the_generator_or_those_of_the_decoder(size):
    """M_L of the paper is of Q^SA_L, which the decoder is given; ``lite`` has learned with what it returns."""
    network = tiny_network(size)
    levels = bev_levels(network.config)
    outputs = decode(network, levels, pose())
    features = network.mask_head.mask_features(levels)
    generated = network.query_generator(levels[::-1], features, network.mask_head)
    decoded = network.mask_head(outputs.queries, features)
    expected = generated.masks[-1] if size == "paper" else decoded
    torch.testing.assert_close(keep(outputs, [2, 5], [0, 1]).masks, expected[:, [2, 5]].sigmoid(), atol=1e-5, rtol=1e-4)
    assert (generated.masks[-1] - decoded).abs().max() > 1e-2
