"""Epochs: everything comes as often as it should, in an order that hangs on nothing but seed and number."""

from collections import Counter
from dataclasses import replace
from itertools import islice, pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from predmapnet.augmentation.frames import AugmentationSettings, load_frame
from predmapnet.errors import UserError
from predmapnet.frame_cache.scene_cache import CachedScene, TrainingScenes
from predmapnet.network.state import BevFeatures
from predmapnet.training.data.draws import PARTS_OF_WEIGHTS, Clips, EpochOrder, step_loader
from predmapnet.training.data.streams import Streams
from predmapnet.training.data.targets import truth_targets
from predmapnet.training.features import FeatureStore
from predmapnet.training.settings import LITE_STAGES
from tests.predmapnet.training.painted_scenes import painted_scene, painted_scenes, tiny_config

CONFIG = tiny_config()


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    return painted_scenes(tmp_path_factory.mktemp("scenes"), 6, CONFIG)


@given(st.lists(st.sampled_from([1.0, 2.5, 0.3, 3.0, 0.05]), min_size=4, max_size=60), st.integers(0, 99))
@settings(deadline=None, max_examples=60)
def test_each_item_comes_as_often_as_its_weight_says(weights, seed):
    if np.round(np.array(weights) * PARTS_OF_WEIGHTS).sum() < PARTS_OF_WEIGHTS:
        return
    order = EpochOrder(np.array(weights), (seed,))
    assert order.draws == pytest.approx(sum(weights), abs=1 + 0.001 * len(weights))
    for epoch in range(3):
        drawn = [order[epoch * order.draws + place] for place in range(order.draws)]
        times = np.bincount(drawn, minlength=len(weights))
        assert (np.floor(weights) <= times).all() and (times <= np.ceil(weights)).all()


def test_over_epochs_a_part_of_a_weight_is_that_part_of_the_draws():
    order = EpochOrder(np.array([1.0] * 20 + [2.5] * 9), (0,))
    times = np.bincount([order[draw] for draw in range(200 * order.draws)])
    np.testing.assert_allclose(times[20:], 500, rtol=0.06)


def test_epochs_stages_and_runs_are_shuffled_anew():
    orders = {
        tuple(order[epoch * 50 + place] for place in range(50))
        for order in (EpochOrder(np.ones(50), seed) for seed in ((0, 1), (0, 2), (1, 1)))
        for epoch in range(3)
    }
    assert len(orders) == 9
    assert all(sorted(order) == list(range(50)) for order in orders)


def test_weights_without_a_frame_are_refused():
    with pytest.raises(UserError, match="epoch"):
        EpochOrder(np.array([0.1, 0.2]), (0,))


def equal_batches(one, other):
    assert torch.equal(one.images, other.images) and torch.equal(one.camera_valid, other.camera_valid)
    assert torch.equal(one.calibration.ego_to_image, other.calibration.ego_to_image)
    assert torch.equal(one.targets.points, other.targets.points)


def test_two_processes_see_what_one_would_have_seen_and_a_resumed_run_what_would_have_come(scenes):
    clips = Clips(scenes, AugmentationSettings(), (3, 1), frames=2, span=3)
    whole = list(islice(step_loader(clips, 4), 5))
    halves = [list(islice(step_loader(clips, 4, rank=rank, size=2), 5)) for rank in range(2)]
    for step, segment in enumerate(whole):
        for number, instant in enumerate(segment.instants):
            parts = [half[step].instants[number] for half in halves]
            assert torch.equal(instant.images, torch.cat([part.images for part in parts]))
            assert torch.equal(instant.ego_to_global, torch.cat([part.ego_to_global for part in parts]))
    resumed = next(iter(step_loader(clips, 4, first=3)))
    equal_batches(resumed.instants[0], whole[3].instants[0])
    assert not torch.equal(whole[0].instants[0].images, whole[3].instants[0].images)


def test_workers_load_the_same(scenes):
    clips = Clips(scenes, AugmentationSettings(), (3, 1))
    alone, helped = (list(islice(step_loader(clips, 3, workers=workers), 3)) for workers in (0, 1))
    for one, other in zip(alone, helped, strict=True):
        equal_batches(one.instants[0], other.instants[0])


def test_the_frames_of_a_clip_are_mirrored_together_and_have_one_wrong_calibration(scenes):
    clips = Clips(scenes, AugmentationSettings(), (3, 1), frames=3, span=4)
    mirrored = set()
    for draw in range(12):
        frames = clips[draw]
        for frame in frames[1:]:
            assert torch.equal(frame.calibration.ego_to_image, frames[0].calibration.ego_to_image)
        # The car drives straight on along x; a mirrored front left camera looks right.
        mirrored.add(tuple(float(frame.calibration.ego_to_image[0, 1, 2, 1]) > 0 for frame in frames))
    assert mirrored == {(True,) * 3, (False,) * 3}


def test_weights_of_scenes_and_of_crossings_decide_how_often_a_frame_is_seen(scenes, tmp_path):
    weighted = TrainingScenes([CachedScene(scene.folder) for scene in scenes.scenes], [1.0, 3.0], CONFIG)
    for scene in weighted.scenes:
        scene.with_crossing[::2] = False
    clips = Clips(weighted, AugmentationSettings(), (0, 1), crossing_weight=2.0)
    seen = Counter(clips.name(draw) for draw in range(len(clips)))
    for scene, weight in zip(weighted.scenes, weighted.weights, strict=True):
        factors = np.array([1.0, 2.0] * 3)
        assert [seen[f"{scene.name} frame {frame}"] for frame in range(6)] == (weight * factors).tolist()
    streams = streams_of(weighted, tmp_path, 12)
    begun = Counter(name.split()[0] for step in range(8) for name in named_fresh(streams, step))
    assert begun["scene-1"] == pytest.approx(3 * begun["scene-0"], rel=0.4)


EXACT = replace(LITE_STAGES[1], augmentation=AugmentationSettings(pose_metres=0.0, pose_degrees=0.0), longest=6)


def streams_of(scenes, folder, count, **changes):
    """Streams whose features tell scene and frame: ten times the one, and the other."""
    store = FeatureStore(folder, ((1, 2, 2),), scenes.scenes)
    for number, scene in enumerate(scenes.scenes):
        rows = torch.arange(float(len(scene)))[:, None, None, None] + 10 * number
        store.write(number, [BevFeatures([rows.expand(len(scene), 1, 2, 2)])])
    return Streams(scenes, store, replace(EXACT, **({"growth_steps": 1} | changes)), count, (0, 2))


def named_fresh(streams, step):
    """Names of the frames with which streams begin at a step."""
    fresh = streams[step].fresh.tolist()
    return [name for name, new in zip(streams.name(step).split(", "), fresh, strict=True) if new]


def test_clips_are_in_the_order_of_time_and_reach_as_far_back_as_asked_for(scenes):
    clips = Clips(scenes, AugmentationSettings(pose_metres=0.0), (3, 1), frames=3, span=5)
    steps = set()
    for draw in range(40):
        places = [frame.ego_to_global[0, 3] for frame in clips[draw]]
        assert places == sorted(places)
        steps |= set((np.diff(places) / 3.0).round().astype(int).tolist())
    assert {1, 2, 3} <= steps


def test_a_frame_is_seen_in_other_light_in_the_next_epoch(scenes):
    clips = Clips(scenes, AugmentationSettings(mirror=0.0), (3, 1))
    names = {clips.name(draw): draw for draw in range(len(clips), 2 * len(clips))}
    for draw in range(3):
        once, again = clips[draw][0], clips[names[clips.name(draw)]][0]
        assert (once.ego_to_global == again.ego_to_global).all() and not (once.images == again.images).all()
    clips = Clips(scenes, AugmentationSettings(), (3, 1))
    hands = [float(clips[draw][0].calibration.ego_to_image[0, 1, 2, 1]) > 0 for draw in range(2 * len(clips))]
    assert hands[: len(clips)] != hands[len(clips) :], "places in the order have nothing to do with it"


def test_streams_see_the_truth_of_their_frame_of_their_hand_and_of_the_frame_that_comes(scenes, tmp_path):
    streams = streams_of(scenes, tmp_path, 2)
    known = 0
    for step in range(12):
        segment, following = streams[step], streams[step + 1]
        for stream in range(2):
            code = int(segment.features[-1].levels[0][stream, 0, 0, 0])
            scene, frame = divmod(code, 10)
            seen = segment.instants[-1].targets
            expected = targets_of(scenes, scene, frame)
            assert torch.equal(seen.points[seen.frame == stream], expected.points)
            after = segment.after.points[segment.after.frame == stream]
            assert len(after) or following.fresh[stream]
            known += len(after) > 0
            assert not len(after) or torch.equal(after, targets_of(scenes, scene, frame + 1).points)
    assert 1 < known < 24


def targets_of(scenes, scene, frame):
    """Truth of a frame as it is stored: scenes of odd numbers mirrored."""
    loaded = load_frame(scenes, scene, frame, FeatureStore.mirrored(scene), images=False)
    return truth_targets([loaded.truth], CONFIG.roi, CONFIG.decoder.points, None)


def test_poses_of_streams_are_as_wrong_as_asked_for(scenes, tmp_path):
    noisy = AugmentationSettings(pose_metres=0.5, pose_degrees=0.0)
    exact, wrong = streams_of(scenes, tmp_path, 12), streams_of(scenes, tmp_path, 12, augmentation=noisy)
    places = [
        torch.cat([instant.ego_to_global[:, :2, 3] for step in range(4) for instant in streams[step].instants])
        for streams in (exact, wrong)
    ]
    assert 0.35 < float((places[1] - places[0]).std()) < 0.65


def test_drives_begin_anywhere_have_any_length_and_scenes_that_are_too_short_are_left_out(scenes, tmp_path):
    short = painted_scene(tmp_path / "short", 2, 9, CONFIG)
    mixed = TrainingScenes([short, *scenes.scenes], [1.0] * 3, CONFIG)
    streams = streams_of(mixed, tmp_path / "run", 2, frames=3)
    names = {name for step in range(30) for name in named_fresh(streams, step)}
    assert not any(name.startswith("short") for name in names)
    assert len({name.split()[2] for name in names}) > 2
    fresh = np.array([streams[step].fresh.tolist() for step in range(30)])
    assert 0.3 < fresh.mean() < 1.0


def test_streams_go_on_from_step_to_step_and_can_begin_at_any(scenes, tmp_path):
    store = FeatureStore(tmp_path, ((1, 2, 2),), scenes.scenes)
    for scene in range(2):
        rows = torch.arange(6.0)[:, None, None, None] + 10 * scene
        store.write(scene, [BevFeatures([rows.expand(6, 1, 2, 2)])])
    growing = replace(EXACT, growth_steps=4)
    streams = Streams(scenes, store, growing, 2, (0, 2))
    steps = [streams[step] for step in range(14)]
    for before, after in pairwise(steps):
        last, first = (each.features[which].levels[0][:, 0, 0, 0] for each, which in ((before, 1), (after, 0)))
        for stream in range(2):
            if not after.fresh[stream]:
                assert first[stream] == last[stream] + 1
                assert len(before.after.frame[before.after.frame == stream]) > 0
    assert 2 < sum(int(each.fresh.sum()) for each in steps) < 28
    again = Streams(scenes, store, growing, 2, (0, 2))[9]
    assert torch.equal(again.features[0].levels[0], steps[9].features[0].levels[0])
    assert torch.equal(again.fresh, steps[9].fresh)
    two = [Streams(scenes, store, growing, 1, (0, 2), rank, 2)[9] for rank in range(2)]
    both = torch.cat([each.features[1].levels[0] for each in two])
    assert torch.equal(both, steps[9].features[1].levels[0])
