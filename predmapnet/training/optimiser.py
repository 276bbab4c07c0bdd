"""AdamW with a schedule over a budget, and the moving average of the weights that is shipped."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import torch
from torch import Tensor, nn

_Network = TypeVar("_Network", bound=nn.Module)


@dataclass(frozen=True)
class OptimiserSettings:
    """What drives the weights; the defaults are those of the two-core findings.

    Attributes:
        learning_rate: its peak.
        betas, weight_decay: of AdamW.
        warmup_steps: until the peak is reached, on a line.
        warmup_start: part of the peak at which the line begins.
        clip_norm: largest norm of the gradient.
        decay_all: norms, biases and other single rows are decayed as well.
        average_decay: of the moving average of the weights; 0 for none, the average is the weights.
        final_fraction: part of the peak that is left at the end.
        rates: factors of the rate, by the beginning of the parameters' names; the longest counts, and 1 for others.
    """

    learning_rate: float = 1e-3
    betas: tuple[float, float] = (0.9, 0.98)
    weight_decay: float = 0.02
    decay_all: bool = False
    warmup_steps: int = 150
    warmup_start: float = 0.0
    clip_norm: float = 10.0
    average_decay: float = 0.998
    final_fraction: float = 0.02
    rates: Mapping[str, float] = field(default_factory=dict)


def make_optimiser(network: nn.Module, settings: OptimiserSettings) -> torch.optim.AdamW:
    """AdamW over the trainable parameters; norms, biases and embeddings of one row are decayed where asked for."""
    by_rate: dict[float, list[nn.Parameter]] = {1.0: []}
    for name, parameter in network.named_parameters():
        if parameter.requires_grad:
            by_rate.setdefault(_rate_of(name, settings.rates), []).append(parameter)
    least = 0 if settings.decay_all else 2
    groups = [
        {"params": [p for p in parameters if (p.ndim >= least) == decays], "weight_decay": decay, "rate": rate}
        for rate, parameters in by_rate.items()
        for decays, decay in ((True, settings.weight_decay), (False, 0.0))
    ]
    # Not fused: on the CPU that pairs the wrong elements where a gradient's memory layout differs from its weight's.
    return torch.optim.AdamW(groups, lr=settings.learning_rate, betas=settings.betas)


def _rate_of(name: str, rates: Mapping[str, float]) -> float:
    """Return the factor of the longest beginning of a parameter's name that has one."""
    found = [start for start in rates if f"{name}.".startswith(f"{start}.")]
    return rates[max(found, key=len)] if found else 1.0


def learning_rate(step: int, progress: float, settings: OptimiserSettings) -> float:
    """Warm up over steps, then fall along a cosine over the budget.

    Args:
        step: optimiser steps of this stage so far.
        progress: part of the stage's budget (time or steps) that is used up, in [0, 1].
        settings: peak and warm-up.
    """
    warmup = min(1.0, settings.warmup_start + (1 - settings.warmup_start) * (step + 1) / settings.warmup_steps)
    cosine = 0.5 * (1 + math.cos(math.pi * min(max(progress, 0.0), 1.0)))
    return settings.learning_rate * warmup * (settings.final_fraction + (1 - settings.final_fraction) * cosine)


class WeightAverage(Generic[_Network]):
    """Exponential moving average of a network's parameters and buffers.

    The decay starts low, ``(1 + updates) / (10 + updates)``, so that the average soon forgets the random start.

    Attributes:
        network: a copy of the network that holds the average.
        updates: how often it was updated.
    """

    def __init__(self, network: _Network, decay: float) -> None:
        self.network: _Network = copy.deepcopy(network).eval().requires_grad_(False)
        self.decay = decay
        self.updates = 0

    @torch.no_grad()
    def update(self, network: nn.Module) -> None:
        """Move the average towards ``network``; integer buffers are copied."""
        decay = min(self.decay, (1 + self.updates) / (10 + self.updates))
        self.updates += 1
        average, current = _floats(self.network), _floats(network)
        torch._foreach_lerp_(average, current, 1 - decay)
        for kept, value in zip(self.network.buffers(), network.buffers(), strict=True):
            if not kept.is_floating_point():
                kept.copy_(value)


def _floats(network: nn.Module) -> list[Tensor]:
    tensors = [*network.parameters(), *network.buffers()]
    return [tensor.detach() for tensor in tensors if tensor.is_floating_point()]
