"""bfloat16 where it may be, float32 where it matters, and memory against time."""

from dataclasses import replace

import pytest
import torch

from predmapnet.network.kernels.deformable_convolution import DeformableConvolution
from predmapnet.network.kernels.low_precision import keep_places_exact
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.training.data.batches import StreamSegment
from predmapnet.training.instants import StageTraining
from predmapnet.training.loop import Trainer
from predmapnet.training.settings import LITE_STAGES
from tests.predmapnet.small_networks import PlainBackbone
from tests.predmapnet.training.painted_scenes import painted_scenes, tiny_config
from tests.predmapnet.training.paper_clips import BEV, JOINT
from tests.predmapnet.training.small_runs import (
    OFTEN,
    drawn,
    metrics,
    nothing_measured,
    one_process,
    planned_for,
    quiet,
    short_clips,
)
from tests.predmapnet.training.tiny_clips import painted_clip, tiny_network, tiny_paper_config

pytestmark = pytest.mark.usefixtures("one_thread")
CONFIG = tiny_paper_config()


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    return painted_clip(tmp_path_factory.mktemp("clips"), CONFIG, frames=2)


def step(network, clip, **options):
    """Losses and gradients of one step."""
    torch.manual_seed(0)
    training = StageTraining(network, JOINT)
    vars(training).update(options)
    terms = training(StreamSegment(clip), 1000)
    network.zero_grad()
    torch.stack(list(terms.values())).sum().backward()
    return terms, {name: p.grad.clone() for name, p in network.named_parameters() if p.grad is not None}


def test_low_precision_is_of_the_images_and_the_bev_encoder_alone_and_places_are_exact(clip):
    network, seen = tiny_network(CONFIG), {}
    deformable = next(module for module in network.modules() if isinstance(module, DeformableConvolution))
    watched = {
        "images": network.image_backbone.resnet.stem,
        "places in images": deformable.offsets,
        "places in bev": network.bev_encoder.layers[0].self_attention.sampling_offsets,
        "decoder": network.map_decoder.classify,
        "motion": network.propagation.motion.perceptron[0],
    }
    keep_places_exact(network)

    def watch(name, result):
        seen[name] = result.dtype

    for name, module in watched.items():
        module.register_forward_hook(lambda _module, _inputs, result, name=name: watch(name, result))
    terms, gradients = step(network, clip, low_precision=True)
    assert seen.pop("images") == torch.bfloat16
    assert set(seen.values()) == {torch.float32} and len(seen) == len(watched) - 1
    assert all(term.dtype == torch.float32 and torch.isfinite(term) for term in terms.values())
    assert all(torch.isfinite(gradient).all() for gradient in gradients.values())
    exact, _ = step(tiny_network(CONFIG), clip)
    for name in ("segmentation", "depth", "focal"):
        assert float(terms[name].detach()) == pytest.approx(float(exact[name].detach()), rel=0.05)


def test_less_memory_changes_nothing(clip):
    """Dropout included: what is computed again draws the same numbers."""
    assert CONFIG.bev.dropout > 0
    plain, lean = (step(tiny_network(CONFIG), clip, save_memory=saved) for saved in (False, True))
    for whole, again in zip(plain, lean, strict=True):
        assert set(whole) == set(again)
        for name, value in whole.items():
            torch.testing.assert_close(again[name], value, msg=lambda text, name=name: f"{name}: {text}")


def test_a_batch_in_parts_is_the_batch(tmp_path):
    """Nearly so where losses are means over cells; the batch norms of the past maps see a part."""
    config = type(CONFIG).model_validate(CONFIG.model_dump() | {"depth": {"enabled": False}, "bev": calm_bev()})
    scenes = painted_scenes(tmp_path / "scenes", 5, config)
    for parts in (1, 2):
        torch.manual_seed(0)
        network = PredMapNet(config)
        network.image_backbone = PlainBackbone(config.bev.width)
        planned = planned_for(short_clips(BEV), 3, batch=2, parts=parts)
        trainer = Trainer(one_process(), network, tmp_path / f"{parts}", OFTEN, quiet)
        trainer.run(planned, drawn(planned, network, scenes, tmp_path), nothing_measured)
    for whole, parted in zip(metrics(tmp_path / "1"), metrics(tmp_path / "2"), strict=True):
        del whole["stage"], parted["stage"]
        assert parted == pytest.approx(whole, rel=1e-2)


def calm_bev():
    return CONFIG.bev.model_dump() | {"dropout": 0.0}


def test_minutes_end_lite_with_its_rate_gone(tmp_path):
    torch.manual_seed(0)
    network = PredMapNet(tiny_config())
    scenes = painted_scenes(tmp_path / "scenes", 5, tiny_config())
    planned = replace(planned_for(LITE_STAGES[0], 1, batch=2), steps=None, minutes=0.02)
    trainer = Trainer(one_process(), network, tmp_path / "run", OFTEN, quiet)
    assert trainer.run(planned, drawn(planned, network, scenes, tmp_path), nothing_measured)
    begin, end = trainer.position.fall
    assert 0 < begin < end == trainer.position.step
    assert trainer.position.finished == ["single"]
