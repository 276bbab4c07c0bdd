"""Queries that are carried forward: the thresholds tau_d and tau_t of Sec. 3.1 with the values of Sec. 4.1."""

from dataclasses import replace

import pytest
import torch

from predmapnet.network.track_selection import select
from predmapnet.presets import PRESETS
from tests.predmapnet.network.paper_network import bev_levels, decode, one_frame_later, pose, tiny_network

pytestmark = [pytest.mark.usefixtures("one_thread")]
PAPER = ["paper-nuscenes", "paper-av2"]


@pytest.mark.parametrize("name", PAPER)
def test_numbers_of_the_paper(name):
    """Sec. 4.1, and n of the appendix."""
    config = PRESETS[name]
    assert (config.decoder.queries, config.decoder.points, config.decoder.width) == (100, 20, 512)
    assert (config.tracking.tau_d, config.tracking.tau_t) == (0.4, 0.5)
    assert config.semantic_queries.mask_threshold == 0.5
    assert (config.history_map.beta, config.history_map.threshold) == (0.9, 0.5)
    assert config.future.histories == 4
    assert config.decoder.classes == 3


@pytest.mark.parametrize("name", PAPER)
def test_all_modules_of_the_paper_are_on_and_nothing_is_added_to_its_tracking(name):
    config = PRESETS[name]
    assert config.semantic_queries.enabled and config.history_map.memory and config.history_map.guidance
    assert config.future.enabled and config.depth.enabled
    assert not config.future.steady_motion
    assert config.decoder.query_assignment == "suppress"
    assert config.tracking.misses_allowed == 0 and not config.tracking.merge and not config.revival.enabled
    assert config.tracking.first_tau_d is None


def scored(network, outputs, scores):
    """Give the rows their scores, whatever the network says."""
    logits = torch.full_like(outputs.layers[-1].logits, -20.0)
    logits[0, :, 1] = -20.0
    for row, score in scores.items():
        logits[0, row, 1] = torch.logit(torch.tensor(score))
    return replace(outputs, layers=[*outputs.layers[:-1], replace(outputs.layers[-1], logits=logits)])


@torch.no_grad()
def test_detections_above_tau_d_are_born_and_tracks_not_above_tau_t_end_at_once():
    tracking = PRESETS["paper-nuscenes"].tracking.model_dump()
    network = tiny_network("paper", tracking=tracking)
    outputs = decode(network, bev_levels(network.config), pose())
    first = select(scored(network, outputs, {1: 0.39, 4: 0.41, 6: 0.9}), None, network.config)
    assert first.instances.track_ids.tolist() == [[0, 1]]
    torch.testing.assert_close(first.instances.scores, torch.tensor([[0.41, 0.9]]))

    state = one_frame_later(network, tracks=3)
    outputs = decode(network, bev_levels(network.config, seed=1), pose(1.0), state)
    chosen = select(scored(network, outputs, {0: 0.51, 1: 0.49, 2: 0.8, 5: 0.39, 9: 0.41}), state, network.config)
    assert chosen.instances.track_ids.tolist() == [[0, 2, 3]]
    torch.testing.assert_close(chosen.instances.queries[0], outputs.queries[0, [0, 2, 9]])


@torch.no_grad()
def test_track_rows_come_before_detections_and_both_are_decoded_together():
    network = tiny_network("paper")
    state = one_frame_later(network, tracks=3)
    outputs = decode(network, bev_levels(network.config, seed=1), pose(1.0), state)
    assert outputs.query_track_ids[0].tolist() == [0, 1, 2] + [-1] * network.config.decoder.queries
    other = replace(state, forecasts=1.0 - state.forecasts)
    changed = decode(network, bev_levels(network.config, seed=1), pose(1.0), other)
    assert (changed.queries - outputs.queries)[:, 3:].abs().max() > 1e-5, "detections see the tracks"
