"""A clip teaches every part of the paper's network, and tracks answer for the element that they stand for."""

from dataclasses import replace

import pytest
import torch
from tiny_clips import painted_clip, tiny_network, tiny_paper_config

from predmapnet.network.image_input import normalise_images
from predmapnet.training.losses.frame import LossSums
from tests.predmapnet.training import paper_clips
from tests.predmapnet.training.paper_clips import BEV, JOINT, WARMUP

CONFIG = tiny_paper_config()


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    return painted_clip(tmp_path_factory.mktemp("clips"), CONFIG, frames=3)


def losses(network, clip, stage=JOINT, step=1000, frames=3):
    return paper_clips.losses(network, clip[:frames], stage, step)


def test_joint_training_reaches_every_parameter_and_learns(clip):
    network = tiny_network(CONFIG)
    optimiser = torch.optim.AdamW(network.parameters(), lr=1e-3)
    totals = []
    for step in range(3):
        torch.manual_seed(0)
        terms = losses(network, clip, step=step)
        total = torch.stack(list(terms.values())).sum()
        optimiser.zero_grad()
        total.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 35.0)
        optimiser.step()
        totals.append(float(total.detach()))
    assert {name for name, p in network.named_parameters() if p.grad is None} == set()
    expected = {"segmentation", "segmentation_dice", "focal", "points", "mask", "depth"}
    assert set(terms) == expected | {"transformation", "forecast"}
    assert all(torch.isfinite(term) for term in terms.values())
    assert totals[-1] < totals[0]


def test_the_first_stage_trains_the_segmentation_and_depth_only(clip):
    network = tiny_network(CONFIG)
    terms = losses(network, clip, BEV, frames=2)
    assert set(terms) == {"segmentation", "segmentation_dice", "depth"}
    torch.stack(list(terms.values())).sum().backward()
    reached = {name.split(".")[0] for name, p in network.named_parameters() if p.grad is not None}
    assert reached == {"image_backbone", "bev_encoder", "segmentation_head", "depth_head"}


def test_images_learn_from_the_frames_of_their_stage_only(clip):
    for stage, learns in ((BEV, [True, False, True]), (JOINT, [False, False, True]), (WARMUP, [False] * 3)):
        frames = [
            replace(frame, images=normalise_images(frame.images, CONFIG.image).requires_grad_()) for frame in clip
        ]
        terms = losses(tiny_network(CONFIG), frames, stage)
        torch.stack(list(terms.values())).sum().backward()
        assert [frame.images.grad is not None for frame in frames] == learns


def test_a_memory_that_is_not_used_yet_changes_nothing(clip):
    network = tiny_network(CONFIG).eval()
    for module in network.modules():
        if isinstance(module, torch.nn.Dropout | torch.nn.MultiheadAttention):
            module.dropout = 0.0
    with torch.no_grad():
        before = losses(network, clip, WARMUP, step=0)
        late = losses(network, clip, WARMUP, step=WARMUP.memory_from_step)
        for layer in network.map_decoder.layers:
            torch.nn.init.normal_(layer.memory_attention.attention.out_proj.bias)
        changed = losses(network, clip, WARMUP, step=WARMUP.memory_from_step)
        unchanged = losses(network, clip, WARMUP, step=0)
    assert all(torch.equal(before[name], unchanged[name]) for name in before)
    assert float(changed["points"]) != pytest.approx(float(late["points"]), rel=1e-4)


def test_without_truth_there_is_only_background(clip):
    nothing = torch.zeros(0, dtype=torch.int64)
    empty = [
        replace(
            frame,
            targets=replace(
                frame.targets,
                frame=nothing,
                kinds=nothing,
                element_ids=nothing,
                points=frame.targets.points[:0],
                masks=frame.targets.masks[:0],
                segmentation=torch.zeros_like(frame.targets.segmentation),
            ),
        )
        for frame in clip
    ]
    terms = losses(tiny_network(CONFIG), empty)
    assert float(terms["points"].detach()) == float(terms["mask"].detach()) == float(terms["forecast"].detach()) == 0.0
    assert float(terms["focal"].detach()) > 0.0


def test_what_one_of_two_processes_found_alone_counts_as_in_one_that_sees_all():
    """One thing in all of the batch: half a thing a process."""
    found, nothing = LossSums(), LossSums()
    found.add("forecast", torch.tensor(3.0), 1)
    nothing.add("forecast", torch.tensor(0.0), 0)
    halves = [sums.means(lambda _: torch.tensor([0.5]), processes=2)["forecast"] for sums in (found, nothing)]
    assert sum(halves) / 2 == found.means(lambda counts: counts)["forecast"] == 3.0
    assert nothing.means(lambda counts: counts)["forecast"] == 0.0
