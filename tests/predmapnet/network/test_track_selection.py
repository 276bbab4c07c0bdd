"""Track selection: birth, support, merging, ids."""

import torch

from predmapnet.config import PredMapNetConfig
from predmapnet.network.state import FrameOutputs, Instances, LayerPredictions
from predmapnet.network.track_selection import select

ROI = torch.tensor([60.0, 30.0])


def config(**tracking):
    return PredMapNetConfig.model_validate({"tracking": tracking, "revival": {"enabled": False}})


class State:
    """The part of a stream's state that selection reads."""

    def __init__(self, ids, misses=None, next_id=100):
        count = len(ids)
        ids = torch.tensor([ids], dtype=torch.long).reshape(1, count)
        misses = torch.tensor([misses or [0] * count], dtype=torch.long).reshape(1, count)
        none = torch.zeros(1, count)
        self.instances = Instances(ids >= 0, ids, ids, none, misses, none, none, none)
        self.next_track_id = torch.tensor([next_id])


def outputs(rows, state=None):
    """Make a frame's outputs from (label, score, y in metres) rows: lines along x from -10 to 10; tracks first."""
    labels, scores, offsets = zip(*rows, strict=True)
    logits = torch.full((1, len(rows), 3), -20.0)
    logits[0, torch.arange(len(rows)), torch.tensor(labels)] = torch.logit(torch.tensor(scores))
    x = torch.linspace(-10, 10, 20)
    lines = torch.stack([torch.stack([x, torch.full_like(x, y)], dim=-1) for y in offsets])
    ids = [] if state is None else state.instances.track_ids[0].tolist()
    return FrameOutputs(
        layers=[LayerPredictions(logits, (lines / ROI + 0.5)[None], torch.zeros(1, len(rows), 5, 10))],
        queries=torch.arange(len(rows)).float().reshape(1, -1, 1),
        query_valid=torch.ones(1, len(rows), dtype=torch.bool),
        query_track_ids=torch.tensor([ids + [-1] * (len(rows) - len(ids))]),
        segmentation=torch.zeros(1),
        bev=torch.zeros(1),
        ego_to_global=torch.eye(4, dtype=torch.float64)[None],
    )


def ids(part):
    return part.track_ids[0][part.valid[0]].tolist()


def came_from(part):
    return part.queries[0, :, 0][part.valid[0]].int().tolist()


def test_births_are_numbered_on_and_weak_detections_are_only_reported():
    chosen = select(outputs([(1, 0.4, 0.0), (1, 0.9, 5.0), (2, 0.01, 9.0), (0, 0.7, -5.0)]), None, config())
    assert ids(chosen.instances) == [0, 1] and came_from(chosen.instances) == [1, 3]
    assert ids(chosen.detections) == [-1] and came_from(chosen.detections) == [0]
    torch.testing.assert_close(chosen.instances.scores, torch.tensor([[0.9, 0.7]]))


def test_a_track_takes_up_the_better_detection_of_its_line():
    state = State([7])
    chosen = select(outputs([(1, 0.6, 0.0), (1, 0.8, 1.0), (1, 0.3, -1.2), (2, 0.9, 0.5)], state), state, config())
    assert ids(chosen.instances) == [7, 100]
    assert came_from(chosen.instances) == [1, 3]
    torch.testing.assert_close(chosen.instances.scores, torch.tensor([[1 - 0.4 * 0.2, 0.9]]))
    assert ids(chosen.detections) == []


def test_a_track_that_is_surer_than_its_detection_keeps_its_own_line():
    state = State([7])
    chosen = select(outputs([(1, 0.9, 0.0), (1, 0.5, 1.0)], state), state, config())
    assert came_from(chosen.instances) == [0] and chosen.instances.misses.tolist() == [[0]]


def test_a_detection_between_two_tracks_supports_the_nearer_one_only():
    state = State([3, 4])
    rows = [(1, 0.2, 0.0), (1, 0.2, 2.5), (1, 0.8, 1.5)]
    chosen = select(outputs(rows, state), state, config(merge_distance=2.0))
    assert ids(chosen.instances) == [3, 4] and came_from(chosen.instances) == [0, 2]
    assert chosen.instances.misses.tolist() == [[1, 0]]


def test_without_support_a_track_lasts_for_the_allowed_misses_and_a_hit_clears_them():
    rules = config(misses_allowed=2)
    for misses, lives in ((0, True), (1, True), (2, False)):
        state = State([5], [misses])
        chosen = select(outputs([(1, 0.1, 0.0), (2, 0.1, 9.0)], state), state, rules)
        assert ids(chosen.instances) == ([5] if lives else [])
    state = State([5], [2])
    assert select(outputs([(1, 0.4, 0.0), (2, 0.1, 9.0)], state), state, rules).instances.misses.tolist() == [[0]]


def test_of_two_tracks_of_one_line_the_older_id_stays():
    state = State([9, 4])
    chosen = select(outputs([(1, 0.9, 0.0), (1, 0.5, 1.0), (2, 0.1, 9.0)], state), state, config())
    assert ids(chosen.instances) == [4]


def test_of_two_newborns_of_one_line_the_better_one_is_born():
    chosen = select(outputs([(1, 0.7, 0.0), (1, 0.9, 1.0), (1, 0.8, 6.0)]), None, config())
    assert came_from(chosen.instances) == [1, 2] and ids(chosen.detections) == []


def test_without_merging_thresholds_alone_decide():
    state = State([7])
    rules = config(merge=False, misses_allowed=0, tau_t=0.5, tau_d=0.6)
    chosen = select(outputs([(1, 0.55, 0.0), (1, 0.8, 0.1), (1, 0.58, 0.2)], state), state, rules)
    assert ids(chosen.instances) == [7, 100] and came_from(chosen.detections) == [2]
    gone = select(outputs([(1, 0.45, 0.0), (1, 0.2, 0.1)], state), state, rules)
    assert ids(gone.instances) == []


def test_ids_are_never_used_again(network, make_inputs):
    """A stream in which tracks end and begin all the time."""
    rules = network.config.model_copy(
        update={"tracking": network.config.tracking.model_copy(update={"tau_d": 0.05, "tau_t": 0.05, "merge": False})}
    )
    for layer in network.map_decoder.layers:
        torch.nn.init.normal_(layer.classify.weight, std=0.3)
    state, seen, before = network.initial_state(2), [set(), set()], [set(), set()]
    for number in range(12):
        inputs = make_inputs(2, seed=number, x=20.0 * number)
        with torch.no_grad():
            frame = network(inputs, state)
            chosen = select(frame, state, rules).instances
            state = network.advance(state, frame, chosen, inputs)
        for stream in range(2):
            now = set(chosen.track_ids[stream][chosen.valid[stream]].tolist())
            assert not (now - before[stream]) & seen[stream]
            assert len(now) == int(chosen.valid[stream].sum())
            seen[stream] |= now
            before[stream] = now
    assert min(len(stream) for stream in seen) > 12
