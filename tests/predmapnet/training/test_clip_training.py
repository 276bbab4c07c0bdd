"""Runs from their options to their weights: all stages, their rates, and what they leave as it is."""

from itertools import islice

import numpy as np
import pytest
import torch

from predmapnet.augmentation.frames import AugmentationSettings
from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.frame_cache.depth_targets import UNKNOWN
from predmapnet.frame_cache.prepare import DataOptions, DataSet
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.runs.train import RunOptions, export, run_stages
from predmapnet.training import run_checkpoint
from predmapnet.training.data.draws import Clips, step_loader
from predmapnet.training.loop import BEST
from predmapnet.training.optimiser import make_optimiser
from predmapnet.training.plan import PlanOptions
from predmapnet.training.settings import BEV_PARTS, NUSCENES_STAGES
from predmapnet.weights.checkpoint import load_checkpoint
from tests.predmapnet.training.painted_scenes import painted_scenes, tiny_config
from tests.predmapnet.training.small_runs import OFTEN, metrics, one_process, quiet
from tests.predmapnet.training.tiny_clips import tiny_paper_config

CONFIG = tiny_paper_config()
pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    return painted_scenes(tmp_path_factory.mktemp("scenes"), 5, CONFIG)


def parameters(checkpoint):
    """Of the network in a checkpoint, without the statistics of batch norms."""
    tensors = run_checkpoint.below_prefix("network", run_checkpoint.read_tensors(checkpoint, "network"))
    return {name: value for name, value in tensors.items() if "running" not in name and "batches" not in name}


def test_a_run_of_the_papers_network_goes_through_its_stages_and_freezes_what_they_leave(scenes, tmp_path):
    options = RunOptions(CONFIG, None, tmp_path, plan=PlanOptions(batch=1, steps=1), loop=OFTEN)
    assert run_stages(one_process(), options, (scenes, []), quiet)
    assert [line["stage"] for line in metrics(tmp_path)] == ["bev", "warmup", "joint"]
    bev, warmup, joint = (parameters(path) for path in sorted(tmp_path.glob("frames-*")))
    for before, after, learns_bev in ((bev, warmup, False), (warmup, joint, True)):
        changed = {name.split(".")[0] for name in before if not torch.equal(before[name], after[name])}
        assert "map_decoder" in changed
        assert (changed >= set(BEV_PARTS)) if learns_bev else not (changed & set(BEV_PARTS))


def test_lite_is_validated_and_its_averaged_and_best_weights_can_be_used(tmp_path):
    config = tiny_config()
    scenes = painted_scenes(tmp_path / "scenes", 8, config, (DEMO_RIG,))
    demo = DataOptions((DataSet("demo"),), tmp_path)
    options = RunOptions(config, demo, tmp_path / "run", plan=PlanOptions(batch=2, steps=2), loop=OFTEN)
    assert run_stages(one_process(), options, (scenes, list(scenes.scenes)), quiet)
    measured = [line for line in metrics(tmp_path / "run") if "val_mAP" in line]
    assert ["val_C-mAP" in line for line in measured if line["step"] == 2] == [False, True], "of streams only"
    shipped = load_checkpoint(export(options))
    assert shipped.facts["finished"] == ["single", "temporal"]
    newest = run_checkpoint.read_tensors(run_checkpoint.latest(tmp_path / "run"), "network")
    average = run_checkpoint.below_prefix("average", newest)
    assert all(torch.equal(value, average[name]) for name, value in shipped.network.state_dict().items())
    best = {line["stage"]: line["val_mAP"] for line in measured}
    assert (tmp_path / "run" / BEST).exists() == any(value > 0 for value in best.values())


def test_clips_end_with_their_frame_and_repeat_for_a_seed(scenes):
    clips = Clips(scenes, AugmentationSettings(), (5, 0), frames=3, span=4)
    (first, *others), again = ([*islice(step_loader(clips, 2, 7), 6)] for _ in range(2))
    assert len(first.instants) == 3
    for one, other in zip(first.instants, again[0].instants, strict=True):
        assert torch.equal(one.images, other.images)
    for segment in (first, *others):
        driven = np.stack([instant.ego_to_global[:, 0, 3].numpy() for instant in segment.instants])
        assert (np.diff(driven, axis=0) >= 0).all(), "in time order"
        assert (driven[-1] - driven[0] <= 4 * 3.0 + 1e-9).all(), "within the span; scenes are driven at 3 m per frame"
    assert first.instants[0].depth.shape == (2, 6, 8, 12)
    assert (first.instants[0].depth != UNKNOWN).any()


def test_parts_learn_at_their_own_rates():
    network = PredMapNet(CONFIG)
    for stage in NUSCENES_STAGES:
        groups = make_optimiser(network, stage.optimiser).param_groups
        rates = {id(p): group["rate"] for group in groups for p in group["params"]}
        assert len(rates) == len(list(network.parameters()))
        joint = stage.name == "joint"
        assert rates[id(network.image_backbone.resnet.stages[0][0].reduce.convolution.weight)] == 0.1
        assert rates[id(network.bev_encoder.layers[0].norms[0].weight)] == (0.5 if joint else 1.0)
        assert rates[id(network.bev_encoder.queries)] == 1.0
        assert rates[id(network.map_decoder.classify.weight)] == 1.0
    assert all(hasattr(network, part) for part in BEV_PARTS)
