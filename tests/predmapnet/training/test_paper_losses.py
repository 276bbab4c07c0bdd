"""Losses of Sec. 3.6 on clips whose losses can be told by hand."""

from math import log

import numpy as np
import pytest
import torch
from torch.nn import functional

from predmapnet.network.ego_motion import relative_motion
from tests.predmapnet.training.paper_clips import (
    BEV,
    BOUNDARY,
    DIVIDER,
    clip_network,
    clip_of,
    forecast_steps,
    line,
    losses,
    say,
    say_masks,
)

DETECTIONS, DECODER_LAYERS, MASK_LAYERS = 12, 2, 3 + 1
SIDEWAYS = 1.5


pytestmark = pytest.mark.usefixtures("one_thread")


def drifting(frames=3):
    """A divider that lies 1.5 m further to the right in every frame."""
    return [[(DIVIDER, 4, line(3.0 - SIDEWAYS * number))] for number in range(frames)]


@pytest.mark.parametrize("weight", [1.0, 0.5])
@torch.no_grad()
def test_a_forecast_of_the_next_frame_costs_nothing_and_one_of_this_frame_its_chamfer_distance(weight):
    """Each track answers for its line in the next frame; every row says where the line is in this one."""
    network, costs = clip_network(), {}
    instants = drifting(2)
    say(network, line(3.0), 0.5)
    for step in (0.0, -SIDEWAYS, SIDEWAYS):
        forecast_steps(network, (0.0, step))
        costs[step] = float(losses(network, clip_of(network, instants), forecast=weight)["forecast"])
    assert costs[-SIDEWAYS] == pytest.approx(0.0, abs=1e-4)
    assert costs[0.0] == pytest.approx(weight * SIDEWAYS, abs=1e-3)
    assert costs[SIDEWAYS] == pytest.approx(weight * 2 * SIDEWAYS, abs=1e-3)


@torch.no_grad()
def test_a_chamfer_distance_looks_both_ways():
    """Half of the line is found: the found half costs nothing, the missing one half of its mean distance."""
    network = clip_network()
    whole, half = line(0.0), line(0.0, x=-7.5, length=15.0)
    say(network, half, 0.5)
    forecast_steps(network, (0.0, 0.0))
    instants = [[(DIVIDER, 4, half)], [(DIVIDER, 4, whole)]]
    distance = np.abs(half[:, None, 0] - whole[None, :, 0])
    expected = (distance.min(axis=0).mean() + distance.min(axis=1).mean()) / 2
    found = float(losses(network, clip_of(network, instants))["forecast"])
    assert found == pytest.approx(expected, abs=1e-3) and expected > 1.0


@torch.no_grad()
def test_forecasts_of_what_is_gone_or_false_cost_nothing_and_the_others_are_averaged():
    network = clip_network()
    say(network, line(3.0), 0.5)
    forecast_steps(network, (0.0, 0.0))
    both = [(DIVIDER, 4, line(3.0)), (BOUNDARY, 4, line(3.0))]
    moved = [(DIVIDER, 4, line(2.0)), (BOUNDARY, 4, line(1.0))]
    for coming, expected in ((moved, 1.5), (moved[:1], 1.0), (moved[1:], 2.0), ([(DIVIDER, 9, line(0.0))], 0.0)):
        assert float(losses(network, clip_of(network, [both, coming]))["forecast"]) == pytest.approx(expected, abs=1e-3)


def mask_terms(network, pieces, logit):
    """Dice and cross-entropy of a mask that says the same everywhere, mean over the pieces of truth."""
    drawn = clip_of(network, [pieces])[0].targets.masks
    drawn = functional.adaptive_max_pool2d(drawn[None], network.config.mask_size)[0].flatten(1)
    probability, cells, painted = 1 / (1 + np.exp(-logit)), drawn.shape[1], drawn.sum(dim=1)
    dice = 1 - (2 * probability * painted + 1) / (probability * cells + painted + 1)
    entropy = -(painted * log(probability) + (cells - painted) * log(1 - probability)) / cells
    return float(dice.mean()), float(entropy.mean())


@pytest.mark.parametrize(("dice", "entropy"), [(2.0, 1.0), (1.0, 0.0), (0.0, 1.0)])
@torch.no_grad()
def test_masks_are_supervised_before_the_first_and_after_each_layer_of_the_generator(dice, entropy):
    network = clip_network()
    say(network, line(3.0), 0.5)
    say_masks(network, -1.0)
    weights = {} if (dice, entropy) == (2.0, 1.0) else {"mask_dice": dice, "mask_entropy": entropy}
    pieces = drifting(1)[0] + [(BOUNDARY, 2, line(-6.0))]
    of_dice, of_entropy = mask_terms(network, pieces, -1.0)
    expected = MASK_LAYERS * (dice * of_dice + entropy * of_entropy)
    assert float(losses(network, clip_of(network, [pieces]), **weights)["mask"]) == pytest.approx(expected)


@torch.no_grad()
def test_the_mask_of_a_track_counts_once_beside_those_of_newborn_detections():
    """A track has one mask; a newborn has as many as there are layers. Both count over all pieces of truth."""
    network = clip_network()
    say(network, line(3.0), 0.5)
    say_masks(network, -1.0)
    old, new = (DIVIDER, 4, line(3.0)), (BOUNDARY, 2, line(-6.0, length=50.0))

    def cost(*pieces):
        of_dice, of_entropy = mask_terms(network, list(pieces), -1.0)
        return 2 * of_dice + of_entropy

    alone = float(losses(network, clip_of(network, [[old], [old]]))["mask"])
    assert alone == pytest.approx((MASK_LAYERS + 1) * cost(old))
    beside = float(losses(network, clip_of(network, [[old], [old, new]]))["mask"])
    assert beside == pytest.approx(MASK_LAYERS * cost(old) + (cost(old) + MASK_LAYERS * cost(new)) / 2)


@pytest.mark.parametrize(("score", "tracks"), [(0.5, True), (0.41, True), (0.39, False)])
@torch.no_grad()
def test_confident_rows_are_tracks_of_the_next_frame_whether_or_not_they_are_right(score, tracks):
    """All rows say the same, so the focal loss tells how many there are; layers and frames are added up."""
    network = clip_network()
    say(network, line(3.0), score)
    terms = losses(network, clip_of(network, drifting(3)))
    expected = 0.0
    for number in range(3):
        rows = DETECTIONS * (number + 1 if tracks else 1)
        positive = 0.25 * (1 - score) ** 2 * -log(score)
        negative = 0.75 * score**2 * -log(1 - score)
        expected += DECODER_LAYERS * 5.0 * (positive + (3 * rows - 1) * negative)
    assert float(terms["focal"]) == pytest.approx(expected, rel=1e-4)
    assert [int(state.instances.valid.sum()) for state in network.states] == [
        DETECTIONS * (number + 1) * tracks for number in range(3)
    ]


@torch.no_grad()
def test_lines_count_fifty_in_every_layer_and_frame():
    """All points lie 1.5 m, 0.05 of the region, beside the truth: smooth L1 with a beta of 0.01."""
    network = clip_network()
    say(network, line(3.0), 0.5)
    instants = [[(DIVIDER, 4, line(3.0 + SIDEWAYS))]] * 3
    expected = 3 * DECODER_LAYERS * 50.0 * (0.05 - 0.005)
    assert float(losses(network, clip_of(network, instants))["points"]) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize(("own", "new"), [(-9.0, 3.0), (3.0, -9.0)])
def test_a_track_answers_for_its_element_and_detections_for_newborn_ones(own, new, order):
    """Whichever of the divider that it stands for and a newborn boundary lies where it says."""
    network = clip_network()
    say(network, line(3.0), 0.5)
    network.map_decoder.classify.bias.requires_grad_(False)
    seen = []

    def watch(_module, _inputs, result):
        logits = result[1][-1][0]
        logits.requires_grad_() if logits.is_leaf else logits.retain_grad()
        seen.append(logits)

    network.map_decoder.register_forward_hook(watch)
    instants = [[(DIVIDER, 4, line(3.0))], [(DIVIDER, 4, line(own)), (BOUNDARY, 7, line(new))][::order]]
    losses(network, clip_of(network, instants))["focal"].backward()
    wanted = [(logits.grad[0] < 0).nonzero().tolist() for logits in seen]
    ((owner, kind),) = wanted[0]
    assert kind == DIVIDER
    (track, its_kind), (detection, new_kind) = sorted(wanted[1])
    assert (track, its_kind, new_kind) == (owner, DIVIDER, BOUNDARY) and detection >= DETECTIONS


@pytest.mark.parametrize("weight", [3.0, 1.0])
@torch.no_grad()
def test_depth_is_learned_in_bins_of_the_last_frame(weight):
    """Equal probabilities of all bins: cross-entropy of each bin, summed over bins, mean over the known cells."""
    network = clip_network()
    network.depth_head.output.weight.zero_()
    network.depth_head.output.bias.zero_()
    bins = network.config.depth.bins
    depth = torch.full((1, 2, 8, 12), -1)
    depth[:, :, 2:5] = 7
    expected = weight * (log(bins) - (bins - 1) * log(1 - 1 / bins))
    weights = {} if weight == 3.0 else {"depth": weight}
    terms = losses(network, clip_of(network, drifting(3), depth=depth), **weights)
    with torch.enable_grad():
        terms = losses(network, clip_of(network, drifting(3), depth=depth), **weights)
    assert float(terms["depth"].detach()) == pytest.approx(expected, rel=1e-4)


@torch.no_grad()
def test_the_segmentation_counts_a_hundred_and_its_dice_one_in_every_frame():
    network = clip_network()
    for parameter in network.segmentation_head.parameters():
        parameter.zero_()
    instants = [[(DIVIDER, 4, line(3.0))]] * 2
    clip = clip_of(network, instants)
    terms = losses(network, clip, BEV)
    drawn = functional.adaptive_max_pool2d(clip[0].targets.segmentation, (20, 40))[0].flatten(1)
    share = float(drawn.mean())
    focal = 0.25 * log(2) * (0.25 * share + 0.75 * (1 - share))
    dice = 1 - (drawn.sum(dim=1) / (0.25 * drawn.shape[1] + drawn.sum(dim=1))).mean()
    assert float(terms["segmentation"]) == pytest.approx(2 * 100.0 * focal, rel=1e-4)
    assert float(terms["segmentation_dice"]) == pytest.approx(2 * float(dice), rel=1e-3)


def test_the_total_has_the_losses_of_the_paper_and_no_others():
    network = clip_network()
    depth = torch.full((1, 2, 8, 12), 3)
    terms = losses(network, clip_of(network, drifting(2), depth=depth))
    bev, track = {"segmentation", "segmentation_dice"}, {"focal", "points", "transformation"}
    assert set(terms) == bev | track | {"mask", "forecast", "depth"}


@torch.no_grad()
def test_noise_of_the_pose_makes_tracks_harder_and_leaves_the_bev_features():
    network = clip_network()
    network.map_decoder.classify.bias.fill_(2.0)
    clip = clip_of(network, drifting(3))
    noisy = ((0.08, 0.0), (0.0, 0.25))
    calm, again = losses(network, clip), losses(network, clip, seed=1)
    assert all(torch.equal(calm[name], again[name]) for name in calm)
    for noise in noisy:
        terms, others = losses(network, clip, noise=noise), losses(network, clip, noise=noise, seed=1)
        for name in ("transformation", "points", "mask"):
            assert float(terms[name]) != pytest.approx(float(calm[name]), rel=1e-4), name
            assert float(terms[name]) != pytest.approx(float(others[name]), rel=1e-5), name
        assert torch.equal(terms["segmentation"], calm["segmentation"])
    first = losses(network, clip[:1]), losses(network, clip[:1], noise=noisy[0])
    assert all(torch.equal(first[0][name], first[1][name]) for name in first[0]), "there is no motion to be wrong"


@torch.no_grad()
def test_the_lasting_memory_is_blended_in_the_true_pose():
    """The noise is for this frame's tracks; what is remembered lies where it was seen (Eq. 4 and 6)."""
    network = clip_network()
    network.map_decoder.classify.bias.fill_(2.0)
    clip = clip_of(network, drifting(3))
    losses(network, clip, noise=(0.5, 4.0))
    for frame, state in zip(clip, network.states, strict=True):
        assert torch.equal(state.ego_to_global, frame.ego_to_global)
    for before, after in zip(network.states[:-1], network.states[1:], strict=True):
        motion = relative_motion(after.ego_to_global, before.ego_to_global)
        warped = network.history_memory.align(before.history_maps, motion)
        kept = after.instances
        tracks = warped.shape[1]
        assert torch.equal(kept.track_ids[:, :tracks], before.instances.track_ids)
        new = kept.masks * kept.scores[..., None, None]
        torch.testing.assert_close(after.history_maps[:, :tracks], 0.1 * warped + 0.9 * new[:, :tracks])
        torch.testing.assert_close(after.history_maps[:, tracks:], new[:, tracks:])


def reached(network, term):
    network.zero_grad()
    term.backward(retain_graph=True)
    return {name for name, value in network.named_parameters() if value.grad is not None and value.grad.any()}


def test_each_module_learns_from_the_losses_that_it_is_meant_to_learn_from():
    network = clip_network(history_map={"threshold": 0.0})
    network.map_decoder.classify.bias.data.fill_(2.0)
    terms = losses(network, clip_of(network, drifting(3)))
    for name in ("focal", "points", "mask"):
        parts = reached(network, terms[name])
        assert not any(part.startswith("propagation.motion") for part in parts), f"{name}: propagated queries"
        for module in ("history_guidance", "future_guidance.fusion", "future_guidance.point_embedding"):
            assert any(part.startswith(module) for part in parts), f"{name}: {module}"
        for module in ("query_generator.layers.0", "bev_encoder"):
            assert any(part.startswith(module) for part in parts), f"{name}: {module}"
    assert any(part.startswith("mask_head") for part in reached(network, terms["mask"]))
    assert any(part.startswith("propagation.motion") for part in reached(network, terms["transformation"]))
    forecast = reached(network, terms["forecast"])
    assert forecast and all(part.startswith("future_guidance.offsets") for part in forecast)
