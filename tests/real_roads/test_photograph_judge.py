"""Figures of the judge of renderings, without the judge."""

import numpy as np
import pytest
from shapely import box

from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.demo_world.street.dressing import dress
from predmapnet.demo_world.world import Divider, LineStyle, Look, Trajectory, VectorMap
from tests.benchmarks.photograph_judge import CLASSES, TrueLabels, intersection_over_union, judged_camera


def test_truth_of_a_straight_road_is_paint_road_kerb_and_other() -> None:
    """A road of 8 m with a solid line in its middle."""
    road = VectorMap((box(0, -4, 60, 4),), (), (), (Divider(np.array([[0.0, 0.0], [60.0, 0.0]]), LineStyle.SOLID),))
    drive = Trajectory(np.array([0]), np.eye(4)[None])
    labels = TrueLabels(dress(road, drive, Look.DAY, 0, "straight")).of(
        np.array([[30.0, 0.02], [30.0, 2.0], [30.0, 3.8], [30.0, 4.2], [30.0, 6.0]])
    )
    assert [CLASSES[label] for label in labels] == ["marking", "road", "kerb", "kerb", "other"]


def test_iou_counts_both_kinds_of_error() -> None:
    confusion = np.zeros((4, 4), dtype=np.int64)
    road, marking, other = CLASSES.index("road"), CLASSES.index("marking"), CLASSES.index("other")
    confusion[road, road], confusion[road, other], confusion[other, road], confusion[marking, road] = 6, 2, 3, 1
    figures = intersection_over_union(confusion)
    assert figures["road"] == pytest.approx(6 / 12)
    assert figures["marking"] == 0.0
    assert figures["road_found"] == pytest.approx(7 / 9)


def test_the_judged_camera_sees_the_same_directions() -> None:
    camera = DEMO_RIG[0]
    point = np.array([2.0, 1.0, 10.0])
    here, there = camera.intrinsics @ point, judged_camera(camera).intrinsics @ point
    scale = 896 / camera.width
    assert there[:2] / there[2] == pytest.approx(scale * here[:2] / here[2] + [0, (512 - scale * camera.height) / 2])
