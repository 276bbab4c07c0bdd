"""The paper's network, small and without dropout, made to say what a test wants, and clips of truth drawn by hand."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import torch
from torch import Tensor

from mapfusion.elements import ElementKind
from predmapnet.config import PredMapNetConfig
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.network.state import StreamState
from predmapnet.presets import parse_config
from predmapnet.scenes import FrameTruth
from predmapnet.training.data.batches import Batch, StreamSegment
from predmapnet.training.data.targets import truth_targets
from predmapnet.training.instants import StageTraining
from predmapnet.training.settings import NUSCENES_STAGES, Stage
from tests.predmapnet.small_networks import PlainBackbone, frames, small_config

BEV, WARMUP, JOINT = NUSCENES_STAGES
GRID = (100, 200)
DIVIDER, BOUNDARY = ElementKind.DIVIDER, ElementKind.BOUNDARY

Piece = tuple[ElementKind, int, np.ndarray]
"""Kind, identity and points ``(n, 2)`` in metres."""


class Watched(PredMapNet):
    """Keeps the states that it passes through."""

    def __init__(self, config: PredMapNetConfig) -> None:
        super().__init__(config)
        self.states: list[StreamState] = []

    def advance(self, *args, **named) -> StreamState:
        self.states.append(super().advance(*args, **named))
        return self.states[-1]


def clip_network(**sections: dict[str, object]) -> Watched:
    """Return a network in training mode whose zero-started branches are open."""
    calm = {"bev": {"dropout": 0.0}, "decoder": {"dropout": 0.0, "points": 20}}
    for section, values in sections.items():
        calm[section] = calm.get(section, {}) | values
    return copy.deepcopy(_built(small_config("paper-nuscenes", **calm).to_json())).train()


@cache
def _built(text: str) -> Watched:
    torch.manual_seed(0)
    network = Watched(parse_config(text, "test"))
    network.image_backbone = PlainBackbone(network.config.bev.width)
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            if not parameter.any() or name.endswith("offsets.weight"):
                parameter.normal_(0, 0.1)
    return network


@torch.no_grad()
def say(network: PredMapNet, line: np.ndarray, score: float) -> None:
    """Let every row of every decoder layer say one line ``(20, 2)``, metres, with one score in all classes."""
    decoder, size = network.map_decoder, np.array([network.config.roi_length, network.config.roi_width])
    last = decoder.line[-1]
    last.weight.zero_()
    last.bias.copy_(torch.from_numpy(line / size + 0.5).flatten().float().logit())
    decoder.classify.weight.zero_()
    decoder.classify.bias.fill_(float(np.log(score / (1 - score))))


@torch.no_grad()
def say_masks(network: PredMapNet, logit: float) -> None:
    """Let every query have the same mask, the same everywhere."""
    last = network.mask_head.embedding[-1]
    last.weight.zero_()
    last.bias.zero_()
    network.mask_head.bias.fill_(logit)


@torch.no_grad()
def forecast_steps(network: PredMapNet, step: tuple[float, float]) -> None:
    """Let every forecast be the last polyline moved by ``step`` metres; the perceptron speaks in tenths."""
    last = network.future_guidance.offsets[-1]
    last.weight.zero_()
    size = torch.tensor([network.config.roi_length, network.config.roi_width])
    last.bias.copy_((10.0 * torch.tensor(step) / size).repeat(network.config.decoder.points))


def line(y: float, x: float = 0.0, length: float = 30.0) -> np.ndarray:
    """Return twenty points along x, ahead and behind."""
    return np.stack([np.linspace(x - length / 2, x + length / 2, 20), np.full(20, float(y))], axis=1)


def clip_of(
    network: PredMapNet, instants: Sequence[Sequence[Piece]], seed: int = 0, depth: Tensor | None = None
) -> list[Batch]:
    """Return a clip of one stream that sees random images and the given truth."""
    config = network.config
    clip = []
    for pieces, inputs in zip(instants, frames(len(instants), seed), strict=True):
        truth = FrameTruth(
            np.array([kind for kind, _, _ in pieces], dtype=np.int64),
            tuple(points for _, _, points in pieces),
            np.array([number for _, number, _ in pieces], dtype=np.int64),
        )
        targets = truth_targets([truth], config.roi, config.decoder.points, GRID)
        clip.append(Batch(**vars(inputs), targets=targets, depth=depth))
    return clip


def losses(
    network: PredMapNet,
    clip: Sequence[Batch],
    stage: Stage = JOINT,
    step: int = 1000,
    seed: int = 0,
    noise: tuple[float, float] = (0.0, 0.0),
    **weights: float,
) -> dict[str, Tensor]:
    """Return the losses of a clip by name, with other weights and noise of the ego motion (angle, distance)."""
    stage = replace(stage, losses=replace(stage.losses, **weights), angle_noise=noise[0], distance_noise=noise[1])
    return StageTraining(network, stage, (seed,))(StreamSegment(list(clip)), step)
