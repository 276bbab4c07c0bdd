"""Lost tracks come back with their id and their memory: when, for how long, and where they lay."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from predmapnet.config import PredMapNetConfig
from predmapnet.network.calibration import Calibration
from predmapnet.network.polylines import clip_polylines
from predmapnet.network.revival import point_line_distances
from predmapnet.network.state import FrameInputs, FrameOutputs, LayerPredictions, StreamState
from predmapnet.network.track_selection import select

ROI = torch.tensor([60.0, 30.0])
DIVIDER, BOUNDARY = 1, 2
PAPER = {"tracking": {"merge": False, "misses_allowed": 0}}


def pose_at(x=0.0, y=0.0, heading=0.0):
    pose = torch.eye(4, dtype=torch.float64)
    pose[:2, :2] = torch.tensor([[math.cos(heading), -math.sin(heading)], [math.sin(heading), math.cos(heading)]])
    pose[:2, 3] = torch.tensor([x, y])
    return pose


def line(y, start=-15.0, end=15.0, count=6):
    """A straight line along x in the global frame."""
    return torch.stack([torch.linspace(start, end, count), torch.full((count,), y)], dim=-1)


class Drive:
    """Streams that are shown lines of the global frame instead of images; lists are per stream of the batch."""

    def __init__(self, network, streams=1, **sections):
        values = network.config.model_dump()
        for name, section in {"revival": {"frames": 4}, **sections}.items():
            values[name] |= section
        network.config = PredMapNetConfig.model_validate(values)
        self.network, self.state = network, network.initial_state(streams)

    def step(self, *seen, pose=None):
        """Show each stream its (label, line) pairs; returns the ids of the lines, None for those without a track."""
        poses = torch.stack([pose_at()] * len(seen) if pose is None else [pose] * len(seen))
        outputs = self.outputs(seen, poses)
        inputs = FrameInputs(torch.zeros(0), torch.zeros(0), poses, Calibration.empty(len(poses)))
        self.selection = select(outputs, self.state, self.network.config)
        lost = self.selection.lost
        self.state = self.network.advance(self.state, outputs, self.selection.instances, inputs, lost)
        tracks = self.selection.instances
        for stream in range(len(seen)):
            alive = tracks.track_ids[stream][tracks.valid[stream]].tolist()
            assert len(set(alive)) == len(alive)
            if self.state.lost is not None:
                kept = self.state.lost
                waiting = kept.track_ids[stream][kept.valid[stream]].tolist()
                assert len(set(waiting)) == len(waiting)
                sure = tracks.valid[stream] & (tracks.misses[stream] == 0)
                assert not set(waiting) & set(tracks.track_ids[stream][sure].tolist())
        rows = tracks.queries[..., 0].long().tolist()
        found = [dict(zip(row, ids, strict=True)) for row, ids in zip(rows, tracks.track_ids.tolist(), strict=True)]
        return [[found[stream].get(row) for row in range(len(lines))] for stream, lines in enumerate(seen)]

    def outputs(self, seen, poses):
        """What is seen are detections. Tracks stay where they are and score nothing."""
        streams, config = len(seen), self.network.config
        tracks, rows = self.state.instances.valid.shape[1], max(1, *(len(lines) for lines in seen))
        total, points = tracks + rows, config.decoder.points
        logits, shapes = torch.full((streams, total, 3), -20.0), torch.full((streams, total, points, 2), 0.5)
        queries = torch.full((streams, total, config.decoder.width), -1.0)
        former = self.state.instances
        logits[:, :tracks].scatter_(2, former.labels[..., None], -10.0)
        shapes[:, :tracks] = former.points
        for stream, lines in enumerate(seen):
            to_ego = torch.linalg.inv(poses[stream]).float()
            for row, (label, metres) in enumerate(lines):
                logits[stream, tracks + row, label] = 3.0
                queries[stream, tracks + row] = row
                moved = metres @ to_ego[:2, :2].T + to_ego[:2, 3]
                shapes[stream, tracks + row] = clip_polylines(moved / ROI + 0.5, torch.tensor(False), ROI)[0]
        return FrameOutputs(
            layers=[LayerPredictions(logits, shapes, torch.zeros(streams, total, *config.mask_size))],
            queries=queries,
            query_valid=torch.cat([self.state.instances.valid, torch.ones(streams, rows, dtype=torch.bool)], dim=1),
            query_track_ids=torch.cat([self.state.instances.track_ids, torch.full((streams, rows), -1)], dim=1),
            segmentation=torch.zeros(1),
            bev=torch.zeros(streams, config.bev.memory.channels, config.bev.rows, config.bev.columns),
            ego_to_global=poses,
            warped_history=self.state.history_maps,
        )


@pytest.fixture
def drive(network):
    return lambda **sections: Drive(network, **(PAPER | sections))


ONE = [(DIVIDER, line(0.0))]


@pytest.mark.parametrize(("missing", "back"), [(0, True), (1, True), (4, True), (5, False), (9, False)])
def test_a_hidden_line_gets_its_id_back_within_k_frames(drive, missing, back):
    stream = drive()
    assert stream.step(ONE) == [[0]]
    for _ in range(missing):
        assert stream.step([]) == [[]]
    assert stream.step(ONE) == [[0 if back else 1]]
    assert stream.step(ONE) == [[0 if back else 1]]


def test_with_merging_too_and_after_the_misses_that_are_allowed(drive):
    stream = drive(tracking={"merge": True, "misses_allowed": 2})
    stream.step(ONE)
    for _ in range(4):
        stream.step([])
    assert not stream.state.instances.valid.any()
    assert stream.step(ONE) == [[0]]


def test_a_track_that_strays_unsupported_loses_its_id_to_the_line_that_it_strayed_from(drive):
    stream = drive(tracking={"merge": True, "misses_allowed": 3})
    stream.step(ONE)
    stream.step([])
    strayed = stream.state.instances.points + torch.tensor([0.0, 0.2])
    stream.state = replace(stream.state, instances=replace(stream.state.instances, points=strayed))
    assert stream.step(ONE) == [[0]]
    assert stream.selection.instances.valid.sum() == 1
    assert not stream.state.lost.valid.any()


def test_another_class_or_another_place_gets_a_new_id(drive):
    stream = drive()
    stream.step(ONE)
    stream.step([])
    assert stream.step([(BOUNDARY, line(0.0)), (DIVIDER, line(4.0))]) == [[1, 2]]
    assert stream.step([(DIVIDER, line(1.0))]) == [[0]]


def test_new_ids_go_on_where_they_were(drive):
    stream = drive()
    stream.step([(DIVIDER, line(0.0)), (DIVIDER, line(6.0))])
    stream.step([])
    assert stream.step([(DIVIDER, line(6.0)), (DIVIDER, line(12.0))]) == [[1, 3]]
    assert stream.step([(DIVIDER, line(-12.0))]) == [[4]]


def test_of_two_candidates_the_closer_one_gets_the_id(drive):
    stream = drive()
    stream.step(ONE)
    stream.step([])
    assert stream.step([(DIVIDER, line(1.0)), (DIVIDER, line(-0.5))]) == [[1, 0]]


def test_who_loses_one_contest_may_win_the_next(drive):
    stream = drive(revival={"frames": 4, "distance": 3.0})
    stream.step([(DIVIDER, line(0.0)), (DIVIDER, line(3.4))])
    stream.step([])
    # The second line is nearest to track 0 as well, but the first one is closer to that.
    assert stream.step([(DIVIDER, line(0.5)), (DIVIDER, line(1.6))]) == [[0, 1]]


def test_the_second_track_of_one_line_does_not_come_back(drive):
    stream = drive(tracking={"merge": True, "misses_allowed": 0, "duplicate_distance": 1.5})
    assert stream.step([(DIVIDER, line(0.0)), (DIVIDER, line(2.0))]) == [[0, 1]]
    both = replace(stream.state.instances, points=stream.state.instances.points.clone())
    stream.state = replace(stream.state, instances=both)
    outputs = stream.outputs([[]], pose_at()[None])
    # Both tracks come to lie on one line and are sure of it.
    outputs.layers[-1].logits[0, :2, DIVIDER] = 3.0
    outputs.layers[-1].points[0, :2] = line(1.0) / ROI + 0.5
    chosen = select(outputs, stream.state, stream.network.config)
    assert chosen.instances.track_ids.tolist() == [[0]]
    assert not chosen.lost.valid.any()


def test_a_line_behind_the_car_is_known_again_after_reversing_or_turning_round(drive):
    stream = drive()
    stream.step(ONE, pose=pose_at(0.0))
    assert stream.step([], pose=pose_at(60.0)) == [[]]
    assert stream.step([], pose=pose_at(120.0, 3.0)) == [[]]
    assert stream.step(ONE, pose=pose_at(5.0, 1.0, math.pi - 0.1)) == [[0]]


def test_only_what_both_frames_could_see_is_compared(drive):
    """A long line, of which the new frame sees the next stretch: 20 m of it were seen before."""
    stream = drive()
    road = [(DIVIDER, line(0.0, -200.0, 200.0, 6))]
    stream.step(road, pose=pose_at(0.0))
    stream.step([], pose=pose_at(20.0))
    assert stream.step(road, pose=pose_at(30.0)) == [[0]]
    stream.step([], pose=pose_at(60.0))
    assert stream.step(road, pose=pose_at(90.0)) == [[1]]  # Nothing of it was seen before.


def test_streams_of_a_batch_do_not_mix(network):
    both = Drive(network, 2, **PAPER)
    assert both.step(ONE, [(DIVIDER, line(5.0)), (DIVIDER, line(0.0))]) == [[0], [0, 1]]
    both.step([], [])
    assert both.step([(DIVIDER, line(5.0))], [(DIVIDER, line(0.0)), (BOUNDARY, line(5.0))]) == [[1], [1, 3]]


def test_the_memory_comes_back_where_the_car_now_sees_it(drive):
    stream = drive()
    stream.step(ONE)
    blot = torch.zeros_like(stream.state.history_maps)
    blot[0, 0, 6, 20] = 1.0
    stream.state = replace(stream.state, history_maps=blot)
    columns = blot.shape[-1]
    cell = 60.0 / columns
    stream.step([], pose=pose_at(2 * cell))
    stream.step(ONE, pose=pose_at(3 * cell))
    # The masks of these outputs are all one half, their score that of the logit 3.
    beta, score = stream.network.config.history_map.beta, torch.tensor(3.0).sigmoid()
    expected = beta * score * 0.5 * torch.ones_like(blot)
    expected[0, 0, 6, 17] += 1 - beta
    torch.testing.assert_close(stream.state.history_maps, expected, atol=1e-5, rtol=0)


def test_its_history_shows_the_car_move_on_while_it_was_missing(drive):
    """As if the line had been seen in every frame."""
    hidden, seen = drive(), drive()
    for x in (0.0, 2.0, 4.0, 6.0, 9.0):
        seen.step(ONE, pose=pose_at(x))
        hidden.step([] if x in (4.0, 6.0) else ONE, pose=pose_at(x))
    for state in (hidden.state, seen.state):
        assert state.point_history_valid.all()
    torch.testing.assert_close(hidden.state.point_history, seen.state.point_history, atol=1e-5, rtol=0)
    torch.testing.assert_close(hidden.state.forecasts, seen.state.forecasts, atol=1e-5, rtol=0)


def test_switched_off_nothing_is_kept_and_on_without_a_loss_nothing_changes(drive):
    lines = [(DIVIDER, line(0.0)), (BOUNDARY, line(8.0))]
    on, off = drive(), drive(revival={"enabled": False})
    for number in range(4):
        assert on.step(lines, pose=pose_at(float(number))) == off.step(lines, pose=pose_at(float(number)))
        assert off.state.lost is None
        for name, tensor in off.state.tensors().items():
            assert torch.equal(tensor, on.state.tensors()[name]), name


def test_no_more_lost_tracks_are_kept_than_there_is_room_for(drive):
    stream = drive(revival={"frames": 4, "capacity": 2})
    stream.step(ONE)
    stream.step([(DIVIDER, line(5.0)), (DIVIDER, line(10.0))])
    stream.step([])
    assert stream.state.lost.track_ids.tolist() == [[1, 2]]
    assert stream.step([*ONE, (DIVIDER, line(10.0))]) == [[3, 2]]


def test_lost_tracks_are_saved_and_forgotten_with_the_state(network):
    both = Drive(network, 2, **PAPER)
    both.step(ONE, ONE)
    both.step([], [])
    before = both.state.tensors()
    restored = StreamState.from_tensors(before).tensors()
    assert restored.keys() == before.keys() and "lost.track_ids" in before
    assert all(torch.equal(restored[name], value) for name, value in before.items())
    assert both.state.detached().lost.valid.tolist() == [[True], [True]]
    both.state = both.state.forgotten(torch.tensor([True, False]))
    # The forgetful stream counts from 0 again; were the lost one kept, its next line would be found to be it.
    assert both.state.lost.valid.tolist() == [[False], [True]]
    assert both.step([(DIVIDER, line(5.0)), *ONE], ONE) == [[0, 1], [0]]


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.floats(-30, 30), st.floats(-15, 15)), min_size=3, max_size=3, unique=True))
def test_distances_to_lines_are_those_of_shapely(vertices):
    import shapely

    points = torch.tensor([[-3.0, 2.0], [0.0, 0.0], [25.0, -9.0]])
    found = point_line_distances(points[None], torch.tensor(vertices)[None])
    expected = shapely.distance(shapely.LineString(vertices), shapely.points(points.numpy()))
    torch.testing.assert_close(found[0], torch.tensor(expected).float(), atol=1e-3, rtol=1e-4)


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(st.lists(st.sampled_from([-9.0, -4.0, 0.0, 0.6, 5.0, 11.0]), max_size=4, unique=True), max_size=8),
    st.booleans(),
)
def test_whatever_appears_and_disappears_ids_are_never_shared(network, frames, merge):
    stream = Drive(network, tracking={"merge": merge, "misses_allowed": 0})
    for heights in frames:
        stream.step([(DIVIDER, line(y)) for y in heights])  # The step checks the ids.
