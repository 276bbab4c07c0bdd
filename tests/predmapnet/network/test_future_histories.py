"""Short-Term Future Guidance: histories and forecasts (Sec. 3.5)."""

import torch

from predmapnet.network.future_guidance import extend_history

NEW = torch.tensor([[False]])
OLD = torch.tensor([[True]])
STEP = torch.tensor([[[1.0, 0.0, -3.0], [0.0, 1.0, 0.0]]])
LABELS = torch.tensor([[1]])
ROW = torch.zeros(1, 1, dtype=torch.long)


def line(x):
    return torch.stack([torch.linspace(x, x + 0.2, 6), torch.full((6,), 0.5)], dim=-1)[None, None]


def grown(count):
    history, valid = torch.zeros(1, 0, 4, 6, 2), torch.zeros(1, 0, 4).bool()
    for number in range(count):
        history, valid = extend_history(history, valid, line(0.5 - 0.05 * number), ROW, OLD if number else NEW)
    return history, valid


def test_a_short_history_is_padded_by_its_oldest_polyline_and_masked():
    history, valid = grown(2)
    assert valid.tolist() == [[[False, False, True, True]]]
    torch.testing.assert_close(history[0, 0, :3], line(0.5)[0].expand(3, -1, -1))
    torch.testing.assert_close(history[0, 0, 3], line(0.45)[0, 0])


def test_a_long_history_keeps_the_last_ones_oldest_first():
    history, valid = grown(6)
    assert valid.all()
    torch.testing.assert_close(history[0, 0], torch.cat([line(0.5 - 0.05 * n)[0] for n in (2, 3, 4, 5)]))


def test_a_line_that_turns_round_turns_its_past_with_it():
    history, valid = grown(3)
    turned, _ = extend_history(history, valid, line(0.35).flip(2), ROW, OLD)
    torch.testing.assert_close(turned, grown(4)[0].flip(3))


def test_an_untrained_forecast_is_the_last_polyline(make_network):
    history, valid = grown(3)
    guidance = make_network(future={"steady_motion": False}).future_guidance
    assert torch.equal(guidance.forecast(history, valid, LABELS, STEP), history[:, :, -1])


def test_an_untrained_forecast_carries_a_still_polyline_by_the_last_step_of_the_car(make_network):
    guidance = make_network(future={"steady_motion": True}).future_guidance
    history, valid = grown(3)  # The car drives 0.05 of the ROI's 60 m per step.
    torch.testing.assert_close(guidance.forecast(history, valid, LABELS, STEP), line(0.5 - 0.05 * 3))


def test_a_forecast_ends_where_the_region_ends(make_network):
    guidance = make_network(future={"steady_motion": True}).future_guidance
    backwards = torch.tensor([[[1.0, 0.0, -30.0], [0.0, 1.0, 0.0]]])  # The line lies from 0.4 to 0.6 of 60 m.
    found = guidance.forecast(*grown(3), LABELS, backwards)[0, 0, :, 0]
    torch.testing.assert_close(found, torch.linspace(0.0, 0.1, 6))


def test_padding_of_a_history_does_not_change_its_forecast(make_network):
    guidance = make_network().future_guidance
    torch.nn.init.normal_(guidance.offsets[-1].weight)
    history, valid = grown(2)
    other = history.clone()
    other[:, :, :2] += 0.3
    torch.testing.assert_close(
        guidance.forecast(history, valid, LABELS, STEP), guidance.forecast(other, valid, LABELS, STEP)
    )
    other[:, :, 2] += 0.3
    assert (
        guidance.forecast(history, valid, LABELS, STEP) - guidance.forecast(other, valid, LABELS, STEP)
    ).abs().max() > 1e-4
