"""AdamW with its learning rate over steps, and the moving average of the weights that ``lite`` ships."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from typing import Generic, TypeVar

import torch
from torch import nn

from predmapnet.training.settings import OptimiserSettings

_Network = TypeVar("_Network", bound=nn.Module)


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
    return torch.optim.AdamW(groups, lr=settings.learning_rate, betas=settings.betas, foreach=True)


def _rate_of(name: str, rates: Mapping[str, float]) -> float:
    """Return the factor of the longest beginning of a parameter's name that has one."""
    found = [start for start in rates if f"{name}.".startswith(f"{start}.")]
    return rates[max(found, key=len)] if found else 1.0


def learning_rate(step: int, fall: tuple[int, int] | None, peak: float, settings: OptimiserSettings) -> float:
    """Warm up to the ``peak`` on a line, then fall along a cosine between two steps (None while they are open)."""
    warmup = min(1.0, settings.warmup_start + (1 - settings.warmup_start) * (step + 1) / settings.warmup_steps)
    if fall is None:
        return peak * warmup
    part = min(max((step - fall[0]) / max(fall[1] - fall[0], 1), 0.0), 1.0)
    cosine = (1 + math.cos(math.pi * part)) / 2
    return peak * warmup * (settings.final_fraction + (1 - settings.final_fraction) * cosine)


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
        pairs = list(zip(self.network.state_dict().values(), network.state_dict().values(), strict=True))
        moving = [(kept, value) for kept, value in pairs if kept.is_floating_point()]
        torch._foreach_lerp_([kept for kept, _ in moving], [value for _, value in moving], 1 - decay)
        for kept, value in pairs:
            if not kept.is_floating_point():
                kept.copy_(value)
