"""Invariance of the fused map: order of frames, place of the world, repeated frames, pauses, broken input."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapfusion import ElementKind, FrameMap, GlobalMap, MapIntegrator, RegionOfInterest
from mapfusion.geometry import transform_points
from tests.mapfusion.map_quality import dense, nearest
from tests.mapfusion.simulation import ROI, pose, town_drive

DRIVE = town_drive(1)


def integrate(frames) -> GlobalMap:
    integrator = MapIntegrator()
    for frame in frames:
        integrator.add(frame)
    return integrator.map()


def agreement(first: GlobalMap, second: GlobalMap, within: float = 0.3) -> float:
    """Share of length of either map that lies within a distance of the other, the smaller of both."""
    shares = []
    for one, other in ((first, second), (second, first)):
        close = total = 0
        for kind in ElementKind:
            points = [dense(e.points) for e in one.of_kind(kind)]
            if points:
                distance = nearest(np.concatenate(points), [e.points for e in other.of_kind(kind)])
                close, total = close + int((distance < within).sum()), total + len(distance)
        shares.append(close / max(total, 1))
    return min(shares)


def frame_map(polylines, kinds=None, number=0, ego_to_global=None, tracks=None, scores=None) -> FrameMap:
    count = len(polylines)
    return FrameMap(
        timestamp=number * 500_000_000,
        ego_to_global=np.eye(4) if ego_to_global is None else ego_to_global,
        roi=ROI,
        kinds=np.array(kinds if kinds is not None else [1] * count, dtype=np.int64),
        scores=np.full(count, 0.8) if scores is None else np.array(scores),
        track_ids=np.arange(count) if tracks is None else np.array(tracks, dtype=np.int64),
        polylines=tuple(np.array(p, dtype=np.float64) for p in polylines),
    )


REFERENCE = integrate(DRIVE.frames)


@settings(max_examples=6, deadline=None, derandomize=True)
@given(st.permutations(range(len(DRIVE.frames))))
def test_order_of_frames_does_not_matter(order):
    shuffled = integrate([DRIVE.frames[i] for i in order])
    assert agreement(REFERENCE, shuffled) > 0.95
    assert abs(len(shuffled) - len(REFERENCE)) <= 0.2 * len(REFERENCE)


@settings(max_examples=4, deadline=None, derandomize=True)
@given(st.floats(-np.pi, np.pi), st.floats(-1e5, 1e5), st.floats(-1e5, 1e5))
def test_place_of_the_world_does_not_matter(heading, x, y):
    moved = pose(x, y, heading)
    frames = [replace(frame, ego_to_global=moved @ frame.ego_to_global) for frame in DRIVE.frames]
    fused = integrate(frames)
    back = GlobalMap(tuple(replace(e, points=transform_points(np.linalg.inv(moved), e.points)) for e in fused))
    assert agreement(REFERENCE, back, within=0.2) > 0.97


def test_repeated_frames_change_nothing():
    integrator = MapIntegrator()
    for frame in DRIVE.frames:
        integrator.add(frame)
        integrator.add(frame)
    assert same(integrator.map(), REFERENCE)
    assert integrator.rejections == {"frame repeated": len(DRIVE.frames)}


def test_a_second_drive_with_the_same_frames_makes_the_map_surer():
    integrator = MapIntegrator()
    for log in ("first", "second"):
        for frame in DRIVE.frames:
            integrator.add(frame, log)
    again = integrator.map()
    assert agreement(REFERENCE, again) > 0.9
    assert np.mean([e.observations for e in again]) > 1.7 * np.mean([e.observations for e in REFERENCE])


def test_every_third_frame_dropped():
    assert agreement(REFERENCE, integrate([f for i, f in enumerate(DRIVE.frames) if i % 3])) > 0.9


def test_time_shift_moves_only_the_times():
    shift = 3_600_000_000_000
    later = integrate([replace(f, timestamp=f.timestamp + shift) for f in DRIVE.frames])
    assert same(
        GlobalMap(tuple(replace(e, first_seen=e.first_seen - shift, last_seen=e.last_seen - shift) for e in later)),
        REFERENCE,
    )


def test_saved_and_resumed_gives_the_same_map(tmp_path):
    integrator = MapIntegrator()
    for frame in DRIVE.frames[:20]:
        integrator.add(frame)
    integrator.save(tmp_path / "state.npz")
    resumed = MapIntegrator.load(tmp_path / "state.npz")
    for frame in DRIVE.frames[20:]:
        resumed.add(frame)
    assert same(resumed.map(), REFERENCE)
    assert [p.name for p in tmp_path.iterdir()] == ["state.npz"]


def test_load_refuses_other_files(tmp_path):
    path = tmp_path / "state.npz"
    path.write_bytes(b"no archive")
    with pytest.raises(ValueError, match="not the saved state"):
        MapIntegrator.load(path)


def test_map_may_be_asked_at_any_time():
    integrator = MapIntegrator()
    for frame in DRIVE.frames:
        integrator.add(frame)
        integrator.map()
    assert same(integrator.map(), REFERENCE)


NAN_LINE = [[0, 0], [np.nan, 1], [5, 5]]
LINE = [[-10, 2], [10, 2]]


@pytest.mark.parametrize(
    ("broken", "reason"),
    [
        (frame_map([LINE], ego_to_global=np.full((4, 4), np.nan), number=99), "pose is not finite"),
        (frame_map([LINE], ego_to_global=np.diag([2.0, 2.0, 2.0, 1.0]), number=99), "pose is not rigid"),
        (frame_map([LINE], ego_to_global=pose(1e9, 0, 0), number=99), "pose lies more than 1e+08 m away"),
        (frame_map([LINE], ego_to_global=pose(1e5, 0, 0), number=99), "pose jumps"),
        (frame_map([LINE], ego_to_global=np.eye(3), number=99), "pose is not 4 x 4"),
        (frame_map([NAN_LINE], number=99), "points not finite"),
        (frame_map([np.zeros((4, 3))], number=99), "points are not (n, 2)"),
        (frame_map([[[1, 1], [1, 1]]], number=99), "line without length"),
        (frame_map([[[1, 1]]], number=99), "fewer than two points"),
        (frame_map([np.zeros((1_000_000, 2))], number=99), "too many points"),
        (frame_map([[[100, 100], [120, 100]]], number=99), "outside the region of interest"),
        (frame_map([LINE], scores=[np.nan], number=99), "score outside [0, 1]"),
        (frame_map([LINE], kinds=[7], number=99), "unknown kind"),
        (frame_map([[[0, 0], [1, 1], [0, 0]]], kinds=[0], number=99), "ring without area"),
    ],
)
def test_broken_input_is_counted_and_changes_nothing(broken, reason):
    integrator = MapIntegrator()
    for number in range(4):
        integrator.add(frame_map([LINE], number=number))
    before = integrator.map()
    integrator.add(broken)
    assert integrator.rejections == {reason: 1}
    assert [e.points.tolist() for e in integrator.map()] == [e.points.tolist() for e in before]


def test_frames_of_lists_and_numpy_integers_can_be_saved_and_resumed(tmp_path):
    integrator = MapIntegrator()
    for number in range(4):
        line = np.array(LINE, dtype=np.float64)
        region = RegionOfInterest()
        integrator.add(FrameMap(np.int64(number * 10**8), np.eye(4).tolist(), region, [1], [0.9], [3], (line,)))
    integrator.save(tmp_path / "state.npz")
    resumed = MapIntegrator.load(tmp_path / "state.npz").map()
    assert [e.points.tolist() for e in resumed] == [e.points.tolist() for e in integrator.map()]
    assert len(resumed) == 1


@pytest.mark.parametrize("length", [0.0, -60.0, np.nan, np.inf])
def test_a_region_without_area_is_refused(length):
    with pytest.raises(ValueError, match="two positive sides"):
        RegionOfInterest(length, 30.0)


def straight_drive(count: int, start: float = 0.0) -> list[FrameMap]:
    """A car at 10 m/s past a line that lies 3 m to its left."""
    return [
        frame_map([[[-30, 3], [30, 3]]], number=n, ego_to_global=pose(start + 5.0 * n, 0, 0), tracks=[4])
        for n in range(count)
    ]


def test_a_log_whose_first_pose_is_wrong_is_mapped_all_the_same():
    frames = straight_drive(20)
    frames[0] = replace(frames[0], ego_to_global=pose(90_000, 0, 0))
    integrator = MapIntegrator()
    for frame in frames:
        integrator.add(frame)
    assert integrator.rejections == {"pose jumps": 2}
    assert [e.length for e in integrator.map()] == [pytest.approx(135.0, abs=10.0)]


@pytest.mark.parametrize("wrong", [{9}, {9, 10}, {6, 14}, {18, 19}])
def test_poses_that_jump_for_a_moment_cost_only_their_own_frames(wrong):
    frames = straight_drive(20)
    for number in wrong:
        frames[number] = replace(frames[number], ego_to_global=pose(90_000, 0, 0))
    integrator = MapIntegrator()
    for frame in frames:
        integrator.add(frame)
    assert integrator.rejections == {"pose jumps": len(wrong)}
    assert len(integrator.map()) == 1


def test_a_log_that_goes_on_elsewhere_is_believed_after_two_frames():
    integrator = MapIntegrator()
    for number, frame in enumerate(straight_drive(20)):
        integrator.add(frame if number < 10 else replace(frame, ego_to_global=pose(90_000 + 5.0 * number, 0, 0)))
    assert integrator.rejections == {"pose jumps": 2}
    assert len(integrator.map()) == 2


def test_equal_track_ids_of_two_drives_are_two_tracks():
    # the second drive's track 7 runs between the lines; its id must not draw it to the first drive's track 7
    lines = [[[-20, 0], [20, 0]], [[-20, 1.6], [20, 1.6]]]
    found = {}
    for second in ("first", "second"):
        integrator = MapIntegrator()
        for number in range(6):
            integrator.add(frame_map(lines, number=number, tracks=[7, 8]), "first")
        integrator.add(frame_map([[[-20, 0.83], [20, 0.83]]], number=6, tracks=[7]), second)
        found[second] = [line.evidence.observations for line in integrator.state.lines.values()]
    assert found == {"first": [7, 6], "second": [6, 7]}


def test_a_track_that_coasts_is_hardly_evidence():
    def confidence(score: float) -> list[float]:
        frames = [frame_map([LINE], number=n) for n in range(2)]
        frames += [frame_map([LINE], number=n, scores=[score]) for n in range(2, 10)]
        return [e.confidence for e in integrate(frames)]

    assert confidence(0.1) == []
    assert confidence(0.8)[0] > confidence(0.25)[0] > 0.5


def test_a_ring_that_crosses_itself_is_repaired():
    bow_tie = [[0, 0], [8, 4], [8, 0], [0, 3.5], [0, 0]]
    integrator = MapIntegrator()
    for number in range(4):
        integrator.add(frame_map([bow_tie], kinds=[0], number=number))
    assert len(integrator.map()) == 1


def test_untracked_elements_do_not_enter():
    assert len(integrate([frame_map([LINE], number=n, tracks=[-1]) for n in range(5)])) == 0


def test_kinds_never_mix():
    frames = [frame_map([LINE, LINE], kinds=[1, 2], number=n) for n in range(5)]
    assert sorted(e.kind for e in integrate(frames)) == [1, 2]


def test_parallel_lines_stay_apart_and_in_place():
    rng = np.random.default_rng(3)
    frames = []
    for number in range(12):
        lines = [
            [[x, y + e] for x in np.linspace(-25, 25, 20)]
            for y, e in zip((0.0, 0.3), rng.normal(0, 0.1, 2), strict=True)
        ]
        frames.append(frame_map(lines, number=number, tracks=[7, 8] if number % 3 else [100 + number, 200 + number]))
    fused = sorted(integrate(frames), key=lambda e: e.points[:, 1].mean())
    assert len(fused) == 2
    assert fused[0].points[:, 1].mean() == pytest.approx(0.0, abs=0.12)
    assert fused[1].points[:, 1].mean() == pytest.approx(0.3, abs=0.12)


def test_a_ghost_dies_and_a_line_seen_often_enough_lives():
    frames = []
    for number in range(10):
        lines = [LINE] if number % 5 else [LINE, [[-10, -5], [10, -5]]]
        frames.append(frame_map(lines, number=number))
    fused = integrate(frames)
    assert len(fused) == 1
    assert fused.elements[0].points[0, 1] == pytest.approx(2.0)
    assert fused.elements[0].confidence > 0.9


def test_roi_cuts_are_not_ends():
    road = np.array([[0.0, 3.0], [150.0, 3.0]])
    frames = []
    for number in range(20):
        x = 30.0 + 5.0 * number
        frames.append(
            frame_map(
                [np.clip(road - [x, 0], [-30, -15], [30, 15])],
                number=number,
                ego_to_global=pose(x, 0, 0),
                tracks=[number],
            )
        )
    fused = integrate(frames)
    assert len(fused) == 1
    assert fused.elements[0].length == pytest.approx(150.0, abs=8.0)
    assert fused.elements[0].track_ids == tuple(range(20))


def test_a_crossing_seen_in_two_halves_is_whole():
    ring = np.array([[33.0, -5.0], [37.0, -5.0], [37.0, 5.0], [33.0, 5.0], [33.0, -5.0]])
    frames = []
    for number in range(12):
        x = 2.0 + 1.0 * number
        local = np.clip(ring - [x, 0], [-30, -15], [30, 15])
        if np.ptp(local[:, 0]) > 0.5:
            frames.append(
                frame_map([local if number % 2 else local[::-1]], kinds=[0], number=number, ego_to_global=pose(x, 0, 0))
            )
    fused = integrate(frames)
    assert len(fused) == 1
    points = fused.elements[0].points
    assert points.min(axis=0) == pytest.approx([33.0, -5.0], abs=0.25)
    assert points.max(axis=0) == pytest.approx([37.0, 5.0], abs=0.25)


def test_one_track_that_is_two_lines():
    rng = np.random.default_rng(0)
    frames = []
    for number in range(20):
        y = 0.0 if number % 2 else 3.5
        frames.append(
            frame_map(
                [[[-20, y], [20, y + rng.normal(0, 0.05)]], [[-20, 3.5 - y], [20, 3.5 - y]]],
                number=number,
                tracks=[5, 6],
            )
        )
    assert sorted(round(float(e.points[:, 1].mean()), 1) for e in integrate(frames)) == [0.0, 3.5]


def same(first: GlobalMap, second: GlobalMap) -> bool:
    """Whether two maps are equal to the last bit."""
    return len(first) == len(second) and all(
        np.array_equal(a.points, b.points)
        and replace(a, points=None, deviation=None) == replace(b, points=None, deviation=None)
        for a, b in zip(first, second, strict=True)
    )


def test_a_ghost_dies_also_where_the_car_hardly_looked():
    """Reported in two frames of ten, over ground of which the far end was in view in the last of them only."""
    road = [[-30, -6], [30, -6]]
    ghost = np.array([[20.0, 3.0], [45.0, 3.0]])
    frames = []
    for number in range(10):
        place = np.eye(4)
        place[0, 3] = 2.0 * number
        seen = [ghost - place[:2, 3]] if number in (8, 9) else []
        frames.append(frame_map([road, *seen], number=number, ego_to_global=place, tracks=[0, 1][: 1 + len(seen)]))
    found = integrate(frames)
    assert [element.track_ids for element in found] == [(0,)]
    steady = integrate([replace(frame, timestamp=i) for i, frame in enumerate(3 * frames[8:])])
    assert {element.track_ids for element in steady} == {(0,), (1,)}
