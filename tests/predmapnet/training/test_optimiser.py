"""The moving average and the schedule."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from predmapnet.training.optimiser import OptimiserSettings, WeightAverage, learning_rate


def test_the_average_follows_the_weights() -> None:
    network = nn.Sequential(nn.Linear(1, 1, bias=False), nn.BatchNorm1d(1))
    average = WeightAverage(network, decay=0.5)
    expected = network[0].weight.item()
    for update, value in enumerate([1.0, -2.0, 3.0, 0.5]):
        with torch.no_grad():
            network[0].weight.fill_(value)
            network[1].running_mean.fill_(value)
            network[1].num_batches_tracked.fill_(update)
        average.update(network)
        decay = min(0.5, (1 + update) / (10 + update))
        expected = decay * expected + (1 - decay) * value
        assert average.network[0].weight.item() == pytest.approx(expected, abs=1e-6)
        assert average.network[1].num_batches_tracked.item() == update
    assert network[0].weight.item() == 0.5, "the network itself is left alone"


def test_the_rate_warms_up_stays_and_falls() -> None:
    settings = OptimiserSettings(learning_rate=1.0, warmup_steps=10)
    assert learning_rate(0, None, 1.0, settings) == pytest.approx(0.1)
    assert learning_rate(100, None, 1.0, settings) == pytest.approx(1.0)
    assert learning_rate(100, (50, 150), 1.0, settings) == pytest.approx(0.51)
    assert learning_rate(160, (50, 150), 1.0, settings) == pytest.approx(0.02)
    assert learning_rate(40, (50, 150), 2.0, settings) == pytest.approx(2.0)
