"""Short-Term Future Guidance, Sec. 3.5: equations 10 to 12."""

from dataclasses import replace

import pytest
import torch

from predmapnet.network.future_guidance import ShortTermFutureGuidance
from predmapnet.presets import PRESETS
from tests.predmapnet.network.paper_network import (
    SIZES,
    advance,
    bev_levels,
    decode,
    keep,
    one_frame_later,
    opened,
    place_code,
    pose,
    tiny_config,
    tiny_network,
)

pytestmark = [pytest.mark.usefixtures("one_thread")]
sizes = pytest.mark.parametrize("size", SIZES)
STILL = torch.eye(2, 3)[None]


def case(size, **future):
    config = tiny_config(size, future=future)
    torch.manual_seed(0)
    return opened(ShortTermFutureGuidance(config)), config


def random_history(config, tracks=2):
    generator = torch.Generator().manual_seed(3)
    shape = (1, tracks, config.future.histories, config.decoder.points, 2)
    return 0.3 + 0.4 * torch.rand(shape, generator=generator)


@pytest.mark.parametrize("name", ["lite", "paper-nuscenes", "paper-av2"])
def test_four_frames_are_remembered(name):
    assert PRESETS[name].future.histories == 4


@sizes
@torch.no_grad()
def test_a_forecast_is_the_last_polyline_and_an_offset_that_the_perceptron_guesses(size):
    """Eq. 10: an offset of (0.03, -0.02) of the region for every point."""
    guidance, config = case(size, steady_motion=False)
    history = random_history(config)
    valid = torch.ones(history.shape[:3], dtype=torch.bool)
    labels = torch.ones(1, 2, dtype=torch.long)
    last = guidance.offsets[-1]
    torch.nn.init.zeros_(last.weight)
    torch.nn.init.zeros_(last.bias)
    torch.testing.assert_close(guidance.forecast(history, valid, labels, STILL), history[:, :, -1])
    last.bias.copy_(torch.tensor([0.3, -0.2]).repeat(config.decoder.points))
    expected = history[:, :, -1] + torch.tensor([0.03, -0.02])
    torch.testing.assert_close(guidance.forecast(history, valid, labels, STILL), expected)


@sizes
@torch.no_grad()
def test_the_offset_depends_on_each_of_the_polylines_and_on_their_order(size):
    guidance, config = case(size, steady_motion=False)
    history = random_history(config)
    valid = torch.ones(history.shape[:3], dtype=torch.bool)
    labels = torch.ones(1, 2, dtype=torch.long)

    def offset(polylines, counted=valid):
        return guidance.forecast(polylines, counted, labels, STILL) - polylines[:, :, -1]

    before = offset(history)
    for slot in range(config.future.histories):
        changed = history.clone()
        changed[:, 0, slot] += 0.05
        assert (offset(changed) - before)[:, 0].abs().max() > 1e-4, f"slot {slot}"
        assert torch.equal(offset(changed)[:, 1], before[:, 1]), "each track has its own future"
    swapped = history[:, :, [1, 0, 2, 3]]
    assert (offset(swapped) - before).abs().max() > 1e-4
    unknown = valid.clone()
    unknown[:, :, 0] = False
    other = history.clone()
    other[:, :, 0] += 0.2
    assert torch.equal(offset(history, unknown), offset(other, unknown)), "padding is not looked at"


@sizes
@torch.no_grad()
def test_a_future_is_the_mean_of_the_codes_of_its_points(size):
    """Eq. 11 by hand, read out through a fusion that passes the future on and nothing else."""
    guidance, config = case(size)
    width, points = config.decoder.width, config.decoder.points
    guidance.fusion.weight.copy_(torch.cat([torch.zeros(width, width), torch.eye(width)], dim=1))
    torch.nn.init.zeros_(guidance.fusion.bias)
    forecast = torch.rand(1, 2, points, 2, generator=torch.Generator().manual_seed(0))
    queries = torch.randn(1, 2, width, generator=torch.Generator().manual_seed(1))
    added = guidance(queries, forecast) - queries
    for track in range(2):
        codes = [guidance.point_embedding(place_code(float(x), float(y))) for x, y in forecast[0, track]]
        torch.testing.assert_close(added[0, track], sum(codes) / points, atol=1e-4, rtol=1e-4)


@sizes
@torch.no_grad()
def test_query_and_future_are_joined_by_a_linear_layer(size):
    """Eq. 12; the residual is in the linear layer: (W + [I, 0]) [Q, PE] + b."""
    guidance, config = case(size)
    width = config.decoder.width
    forecast = torch.rand(1, 1, config.decoder.points, 2, generator=torch.Generator().manual_seed(0))
    queries = torch.randn(1, 1, width, generator=torch.Generator().manual_seed(1))
    codes = torch.stack([guidance.point_embedding(place_code(float(x), float(y))) for x, y in forecast[0, 0]])
    weight = guidance.fusion.weight + torch.eye(width, 2 * width)
    expected = weight @ torch.cat([queries[0, 0], codes.mean(dim=0)]) + guidance.fusion.bias
    torch.testing.assert_close(guidance(queries, forecast)[0, 0], expected, atol=1e-4, rtol=1e-4)


@sizes
@torch.no_grad()
def test_tracks_are_told_their_forecast_and_not_their_past(size):
    network = tiny_network(size)
    state, levels, later = one_frame_later(network), bev_levels(network.config, seed=1), pose(1.0)
    before = decode(network, levels, later, state)
    other = replace(state, forecasts=state.forecasts * 0.5)
    assert (decode(network, levels, later, other).queries - before.queries)[:, :3].abs().max() > 1e-3
    unlike = replace(state, point_history=state.point_history * 0.5)
    assert torch.equal(decode(network, levels, later, unlike).queries, before.queries)


@sizes
@torch.no_grad()
def test_each_track_is_told_its_own_forecast(size):
    network = tiny_network(size)
    state, levels = one_frame_later(network), bev_levels(network.config, seed=1)
    guidance = network.future_guidance
    queries = state.instances.queries
    before = guidance(queries, state.forecasts)
    turned = state.forecasts.clone()
    turned[:, 1] *= 0.5
    after = guidance(queries, turned)
    assert torch.equal(before[:, [0, 2]], after[:, [0, 2]]) and not torch.equal(before[:, 1], after[:, 1])
    assert levels[0].isfinite().all()


@sizes
@torch.no_grad()
def test_polylines_are_remembered_oldest_first_by_the_track_that_they_are_of(size):
    network = tiny_network(size)
    length = network.config.future.histories
    state, seen = None, []
    for number in range(length + 2):
        outputs = decode(network, bev_levels(network.config, seed=number), pose(2.0 * number), state)
        last = outputs.query_valid.shape[1] - 1
        # Track 7 changes its row from frame to frame; what is beside it begins anew every time.
        rows, ids = ([last, last - 1], [7, 100 + number]) if number % 2 else ([last - 1, last], [200 + number, 7])
        kept = keep(outputs, rows, ids)
        # A line that would be nearer the other way round is turned; these are all alike, but for their place.
        line = torch.linspace(0.2, 0.6, network.config.decoder.points)
        points = torch.stack([line, torch.full_like(line, 0.3 + 0.03 * number)], dim=-1)
        kept = replace(kept, points=torch.stack([points, points])[None].clone())
        seen.append(points)
        state = advance(network, state, outputs, kept)
    row = state.instances.track_ids[0].tolist().index(7)
    assert state.point_history_valid[0, row].all()
    torch.testing.assert_close(state.point_history[0, row], torch.stack(seen[-length:]))
    assert state.point_history_valid[0, 1 - row].sum() == 1


@torch.no_grad()
def test_the_forecast_of_the_paper_is_made_of_the_polylines_of_this_frame():
    network = tiny_network("paper")
    torch.nn.init.zeros_(network.future_guidance.offsets[-1].weight)
    torch.nn.init.zeros_(network.future_guidance.offsets[-1].bias)
    state = one_frame_later(network)
    outputs = decode(network, bev_levels(network.config, seed=1), pose(2.0), state)
    after = advance(network, state, outputs, keep(outputs, [0, 2], [0, 2]))
    assert torch.equal(after.forecasts, after.instances.points)


@torch.no_grad()
def test_with_steady_motion_a_still_line_is_expected_where_the_same_step_takes_it():
    """The car drives forward by 3 m and to the left by 1.5 m, of 60 m and 30 m."""
    network = tiny_network("lite")
    torch.nn.init.zeros_(network.future_guidance.offsets[-1].weight)
    torch.nn.init.zeros_(network.future_guidance.offsets[-1].bias)
    line = torch.linspace(0.3, 0.6, network.config.decoder.points)
    state = None
    for number in range(2):
        outputs = decode(network, bev_levels(network.config), pose(3.0 * number, 1.5 * number), state)
        kept = keep(outputs, [0], [0])
        points = torch.stack([line - 0.05 * number, torch.full_like(line, 0.5) - 0.05 * number], dim=-1)
        kept = replace(kept, points=points[None, None], labels=torch.ones(1, 1, dtype=torch.long))
        state = advance(network, state, outputs, kept)
    expected = torch.stack([line - 0.1, torch.full_like(line, 0.4)], dim=-1)
    torch.testing.assert_close(state.forecasts[0, 0], expected, atol=1e-4, rtol=0)
