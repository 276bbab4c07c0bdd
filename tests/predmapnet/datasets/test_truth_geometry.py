"""Properties of the ground truth that hold on any map, and the true map of a whole log."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import LineString, Polygon

from mapfusion.elements import ElementKind, RegionOfInterest
from mapfusion.geometry import rotation_of_quaternion
from predmapnet.datasets.ground_truth.crossings import merge_crossings
from predmapnet.datasets.ground_truth.lane_dividers import LaneSide, chain_dividers, connected, relinked
from predmapnet.datasets.ground_truth.nuscenes import NuScenesGroundTruth
from predmapnet.datasets.ground_truth.tracks import normalised
from predmapnet.datasets.ground_truth.whole_map import drop_repeated_lines, join_lines, truth_map
from predmapnet.datasets.poses import combined, pose_matrix, quaternion_of
from predmapnet.demo_world.truth import truth_from_vector_map
from predmapnet.demo_world.world import Crossing, CrossingStyle, Divider, LineStyle, VectorMap
from predmapnet.errors import UserError
from tests.predmapnet.datasets.official_forms import permuted

ROI = RegionOfInterest()
properties = settings(max_examples=20, deadline=None, derandomize=True)


def lidar_pose(x, y, yaw):
    """Pose of a lidar (x right, y forward) on a car that heads along ``yaw``."""
    pose = np.eye(4)
    across = yaw - np.pi / 2
    pose[:2, :2] = [[np.cos(across), -np.sin(across)], [np.sin(across), np.cos(across)]]
    pose[:2, 3] = x, y
    return pose


def turned(points, yaw, shift):
    cosine, sine = np.cos(yaw), np.sin(yaw)
    return points @ np.array([[cosine, sine], [-sine, cosine]]) + shift


def road(yaw=0.0, shift=(0.0, 0.0)):
    """A road with an island, a crossing of two pieces and two dividers, turned and shifted as a whole."""

    def polygon(points, holes=()):
        turned_holes = [turned(np.array(hole, float), yaw, shift) for hole in holes]
        return Polygon(turned(np.array(points, float), yaw, shift), turned_holes)

    def line(points):
        return Divider(turned(np.array(points, float), yaw, shift), LineStyle.DASHED)

    island = [(5, 3), (9, 3), (9, 5), (5, 5)]
    pieces = ([(-9, 0), (-6, 0), (-6, 4), (-9, 4)], [(-9, 4), (-6, 4), (-6, 8), (-9, 8)])
    return VectorMap(
        road_segments=(polygon([(-90, 0), (90, 0), (90, 8), (-90, 8)], [island]),),
        lanes=(polygon([(-90, 0), (90, 0), (90, 3), (-90, 3)]),),
        crossings=tuple(Crossing(polygon(piece), CrossingStyle.ZEBRA, 0.0) for piece in pieces),
        dividers=(line([(-60, 2), (0, 2)]), line([(0, 2), (60, 2)])),
    )


@properties
@given(yaw=st.floats(-3.2, 3.2), x=st.floats(-2000, 2000), y=st.floats(-2000, 2000))
def test_truth_moves_with_the_map(yaw, x, y):
    """Turning and shifting map and car together changes nothing in the ego frame."""
    still = truth_from_vector_map(road()).frame(lidar_pose(0.123, 3.9, 0.05), ROI)
    ((px, py),) = turned(np.array([[0.123, 3.9]]), yaw, (x, y))
    moved = truth_from_vector_map(road(yaw, (x, y))).frame(lidar_pose(px, py, 0.05 + yaw), ROI)
    assert moved.kinds.tolist() == still.kinds.tolist()
    for line, other in zip(moved.polylines, still.polylines, strict=True):
        assert shapely.hausdorff_distance(LineString(line), LineString(other)) < 1e-6


def test_pieces_of_a_crossing_become_one_ring_and_the_island_a_closed_boundary():
    truth = truth_from_vector_map(road()).frame(lidar_pose(0, 4, 0), ROI)
    assert truth.kinds.tolist() == [0, 1, 1, 2, 2, 2]
    crossing = truth.polylines[0]
    np.testing.assert_array_equal(crossing[0], crossing[-1])
    assert Polygon(crossing).area == pytest.approx(24.0)
    island = truth.polylines[-1]
    np.testing.assert_allclose(island[0], island[-1])
    assert Polygon(island).area == pytest.approx(8.0, abs=0.1)
    # Walking along a boundary, the drivable side is on the right hand: islands run the other way round.
    assert LineString(island).is_ring and shapely.is_ccw(shapely.linearrings(island))


def test_boundaries_end_twenty_centimetres_inside():
    truth = truth_from_vector_map(road()).frame(lidar_pose(0, 4, 0), ROI)
    kerbs = [line for line, kind in zip(truth.polylines, truth.kinds, strict=True) if kind == 2][:2]
    np.testing.assert_allclose(np.abs([line[[0, -1], 0] for line in kerbs]), 29.8)


def test_ids_name_the_same_element_over_the_frames():
    truth = truth_from_vector_map(road())
    where = {kind: {} for kind in range(3)}
    for x in np.arange(-40.0, 40.0, 5.0):
        frame = truth.frame(lidar_pose(x, 4, 0), ROI)
        for kind, number, line in zip(frame.kinds, frame.element_ids, frame.polylines, strict=True):
            where[int(kind)].setdefault(int(number), []).append(np.abs(line + np.array([x, 4])))
    # One crossing of two merged pieces, two dividers, the outline of the road and its island.
    assert [set(ids) for ids in where.values()] == [{0}, {0, 1}, {0, 1}]
    (island,) = [lines for lines in where[2].values() if max(line[:, 0].max() for line in lines) < 10]
    assert all(np.isin(np.round(line[:, 1], 6), [3, 5]).all() for line in island)


@properties
@given(yaw=st.floats(-3.2, 3.2), x=st.floats(-3000, 3000), inside=st.floats(1.5, 6.0))
def test_a_crossing_over_the_corner_of_the_region_keeps_the_corner(yaw, x, inside):
    """Cut edges lie on the border only up to rounding; whatever that does, the corner stays."""
    pose = lidar_pose(x, -x / 3, yaw)
    corner = np.array([30 - inside, 15 - inside])
    ring = np.array([corner, corner + (9, 0), corner + (9, 9), corner + (0, 9)])  # noqa: RUF005
    polygon = Polygon(turned(ring, yaw, pose[:2, 3]))
    truth = truth_from_vector_map(VectorMap((), (), (Crossing(polygon, CrossingStyle.ZEBRA, 0.0),), ()))
    (contour,) = truth.frame(pose, ROI).polylines
    assert Polygon(contour).area == pytest.approx(inside**2, abs=1e-6)


def test_an_invalid_polygon_is_left_out():
    bow_tie = Polygon([(0, 0), (4, 4), (4, 0), (0, 4)])
    plain = road()
    spoilt = VectorMap(
        (*plain.road_segments, bow_tie), plain.lanes, (Crossing(bow_tie, CrossingStyle.ZEBRA, 0.0),), plain.dividers
    )
    truth = truth_from_vector_map(spoilt).frame(lidar_pose(0, 4, 0), ROI)
    assert truth.kinds.tolist() == [1, 1, 2, 2, 2]


def test_the_whole_map_joins_what_frames_see_in_pieces():
    truth = truth_from_vector_map(road())
    frames = [(number * 500_000_000, lidar_pose(5.0 * number - 20, 4, 0)) for number in range(9)]
    whole = truth_map(truth, frames, ROI)
    assert [len(whole.of_kind(kind)) for kind in ElementKind] == [1, 1, 3]
    divider = whole.of_kind(ElementKind.DIVIDER)[0]
    assert divider.length == pytest.approx(100.0)
    assert (divider.first_seen, divider.last_seen, divider.observations) == (0, 4_000_000_000, 9)
    crossing = whole.of_kind(ElementKind.PED_CROSSING)[0]
    assert (crossing.length, crossing.observations) == (pytest.approx(22.0), 9)
    # Each frame's own truth lies on the whole map.
    for _, pose in frames:
        frame = truth.frame(pose, ROI)
        for kind, line in zip(frame.kinds, frame.polylines, strict=True):
            if kind != ElementKind.PED_CROSSING:
                there = turned(line, 0.0, pose[:2, 3])
                lines = shapely.union_all([LineString(e.points) for e in whole.of_kind(ElementKind(kind))])
                assert shapely.within(LineString(there), lines.buffer(1e-6))


def test_crumbs_and_skew_pieces_of_crossings():
    def box(x, y, width, height, angle=0.0):
        return shapely.affinity.rotate(shapely.box(x, y, x + width, y + height), angle)

    assert len(merge_crossings([box(0, 0, 8, 3), box(8, 0, 8, 3)])) == 1
    assert len(merge_crossings([box(0, 0, 8, 3), box(8.5, 0, 8, 3)])) == 2, "a gap keeps them apart"
    assert len(merge_crossings([box(0, 0, 8, 3), box(7, -3, 3, 8, 30)])) == 2, "another direction"
    assert merge_crossings([box(0, 0, 0.9, 1)]) == [], "less than a square metre"
    assert merge_crossings([]) == []


lines = st.lists(
    st.lists(st.tuples(st.floats(-50, 50), st.floats(-50, 50)), min_size=2, max_size=5, unique=True),
    min_size=0,
    max_size=8,
)


@properties
@given(lines)
def test_joining_keeps_every_metre(coordinates):
    originals = [np.array(line) for line in coordinates]
    joined = join_lines(originals)
    before = sum(LineString(line).length for line in originals)
    after = sum(LineString(line).length for line in joined)
    assert len(joined) <= len(originals)
    assert after == pytest.approx(before, abs=0.2 * len(originals) + 1e-9)


def test_a_line_digitised_twice_counts_once():
    long = np.array([[0.0, 0], [10, 0], [20, 1]])
    part = np.array([[2.0, 0.05], [8, 0.05]])
    beside = np.array([[0.0, 0.5], [10, 0.5]])
    kept = drop_repeated_lines([part, long, beside, long.copy()])
    assert [len(line) for line in kept] == [3, 2]


def test_branching_lanes_give_overlapping_paths_and_loops_none():
    def side(lane, points, before=(), after=()):
        return LaneSide(lane, np.array([(x, y, 0.0) for x, y in points]), 0, before, after)

    stem = side(1, [(0, 0), (10, 0)], after=(2, 3))
    branches = side(2, [(10, 0), (20, 5)], before=(1,)), side(3, [(10, 0), (20, -5)], before=(1,))
    paths = chain_dividers({side.lane: side for side in (stem, *branches)})
    assert [path.coords[-1][:2] for path in paths] == [(20.0, 5.0), (20.0, -5.0)]
    loop = {
        1: side(1, [(0, 0), (9, 0)], before=(2,), after=(2,)),
        2: side(2, [(9, 0), (9, 9), (0, 0)], before=(1,), after=(1,)),
    }
    assert chain_dividers(relinked(loop)) == []


def test_connecting_prefers_the_start_and_repeats_the_joint():
    first, second = np.array([[0.0, 0, 0], [5, 0, 0]]), np.array([[5.05, 0, 0], [9, 0, 0]])
    (joined,) = connected([first, second])
    np.testing.assert_array_equal(joined[:, 0], [0, 5, 5.05, 9])
    apart = connected([first, second + np.array([0, 0, 1.0])])
    assert len(apart) == 2, "the gap is measured in space"


@properties
@given(st.floats(-0.2, 1.2), st.floats(0.1, 1.0))
def test_permutations_are_the_same_line(start, length):
    line = np.stack([np.linspace(start, start + length, 20), np.full(20, 0.5)], axis=1)
    forms = permuted(line)
    assert forms.shape == (38, 20, 2)
    np.testing.assert_array_equal(forms[0], forms[1][::-1])
    assert (forms[2:] == 1e5).all()


def test_permutations_of_a_ring_start_everywhere_and_run_both_ways():
    angle = np.linspace(0, 2 * np.pi, 20)
    ring = normalised(np.stack([5 * np.cos(angle), 5 * np.sin(angle)], axis=1), ROI)
    forms = permuted(ring)
    np.testing.assert_allclose(forms[:, 0], forms[:, -1])
    np.testing.assert_allclose(forms[0], ring, atol=1e-12)
    np.testing.assert_array_equal(forms[3, 0], ring[:-1][-3])
    assert len({tuple(np.round(form[:2].ravel(), 9)) for form in forms}) == 38


@properties
@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1))
def test_rotation_matrices_are_rotations(quaternion):
    rotation = rotation_of_quaternion(np.array(quaternion))
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    back = quaternion_of(rotation)
    unit = np.array(quaternion) / np.linalg.norm(quaternion)
    np.testing.assert_allclose(back * np.sign(back @ unit), unit, atol=1e-9)


def test_combining_poses_is_their_product():
    first, second = (pose_matrix([np.cos(a), 0, 0, np.sin(a)], [a, 2, 3], "here") for a in (0.3, 1.7))
    np.testing.assert_allclose(combined(first, second), first @ second, atol=1e-12)


def test_corners_are_lost_as_officially_unless_they_are_to_be_kept(small_map):
    """A crossing over the corner of the region: some poses lose the corner by rounding, none if it is kept."""
    official, keeping = NuScenesGroundTruth(small_map), NuScenesGroundTruth(small_map, keep_corners=True)
    assert official.fingerprint != keeping.fingerprint
    areas = {False: [], True: []}
    for yaw in np.linspace(0.3, 0.9, 60):
        pose = lidar_pose(
            101.5 - 29.5 * np.cos(yaw) + 14.5 * np.sin(yaw), 4 - 29.5 * np.sin(yaw) - 14.5 * np.cos(yaw), yaw
        )
        for truth in (official, keeping):
            frame = truth.frame(pose, ROI)
            areas[truth.keep_corners].append(
                sum(Polygon(frame.polylines[row]).area for row in np.flatnonzero(frame.kinds == 0))
            )
    lost = np.array(areas[True]) - np.array(areas[False])
    assert (lost > -1e-6).all() and (lost > 1e-3).any() and (lost < 1e-6).any()


def test_a_quaternion_turns_the_right_way():
    pose = pose_matrix([np.cos(0.25), 0, 0, np.sin(0.25)], [1, 2, 3], "here")
    np.testing.assert_allclose(pose[:3, 0], [np.cos(0.5), np.sin(0.5), 0])
    with pytest.raises(UserError, match="here: the pose is not a rigid motion"):
        pose_matrix([2.0, 0, 0, 0], [0, 0, 0], "here")


def test_a_map_of_another_kind_is_refused():
    with pytest.raises(UserError, match="not a nuScenes map expansion"):
        NuScenesGroundTruth({"lane_segments": {}})
