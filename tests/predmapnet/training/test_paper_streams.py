"""The prediction loss of Sec. 3.6 where ``lite`` learns in streams: forecasts answer for the frame that comes."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from predmapnet.network.calibration import Calibration
from predmapnet.network.state import BevFeatures
from predmapnet.scenes import FrameTruth
from predmapnet.training.data.batches import Batch, StreamSegment
from predmapnet.training.data.streams import NO_TRUTH
from predmapnet.training.data.targets import truth_targets
from predmapnet.training.instants import StageTraining
from predmapnet.training.settings import LITE_STAGES, TrackRules
from tests.predmapnet.network.paper_network import bev_levels, pose, tiny_network
from tests.predmapnet.training.paper_clips import DIVIDER, GRID, forecast_steps, line

STEP = -1.5
EXACT = replace(LITE_STAGES[1], tracks=TrackRules(score=0.3, false_tracks=0))


def standing_car(config, offsets, after):
    """Frames of a car that stands still while a divider drifts, and what comes after them."""

    def targets(y):
        truth = NO_TRUTH if y is None else FrameTruth(np.array([DIVIDER]), (line(y),), np.array([4]))
        return truth_targets([truth], config.roi, config.decoder.points, GRID)

    seen = torch.ones(1, 1, dtype=torch.bool)
    instants = [Batch(torch.zeros(1, 0), seen, pose(), Calibration.empty(1), targets(y)) for y in offsets]
    features = [BevFeatures(bev_levels(config)) for _ in offsets]
    return StreamSegment(instants, features, torch.zeros(1, dtype=torch.bool), targets(after))


@pytest.mark.parametrize(("offsets", "after"), [([3.0], 3.0 + STEP), ([3.0, 3.0 + STEP], None)])
@pytest.mark.usefixtures("one_thread")
@torch.no_grad()
def test_a_forecast_of_the_next_frame_costs_nothing_and_one_of_this_frame_its_distance(offsets, after):
    network = tiny_network("lite", decoder={"points": 20}).train()
    size = torch.tensor([network.config.roi_length, network.config.roi_width])
    guess = network.query_generator.first_guess[-1]
    guess.weight.zero_()
    guess.bias.copy_((torch.from_numpy(line(3.0)).float() / size + 0.5).flatten().logit())
    for layer in network.map_decoder.layers:
        for parameter in [*layer.move.parameters(), *layer.classify.parameters()]:
            parameter.zero_()
    costs = []
    for step in (STEP, 0.0):
        forecast_steps(network, (0.0, step))
        training = StageTraining(network, EXACT)
        costs.append(float(training(standing_car(network.config, offsets, after), 0)["forecast"]))
    assert costs[0] == pytest.approx(0.0, abs=1e-3)
    both_kinds = 2 * abs(STEP)  # The chamfer distance, and point by point.
    assert costs[1] == pytest.approx(EXACT.losses.forecast * both_kinds / len(offsets), rel=1e-2)
