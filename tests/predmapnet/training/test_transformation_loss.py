"""The transformation loss asks that carried queries are read out where their element has moved to."""

import pytest
import torch

from mapfusion.elements import RegionOfInterest
from predmapnet.network.ego_motion import move_points, plane_motion
from predmapnet.network.maptracker.motion_mlp import MotionMlp
from predmapnet.training.losses.terms import focal_loss, transformation_losses
from predmapnet.training.losses.weights import PAPER_LOSSES

ROI = RegionOfInterest()
POINTS, BACKGROUND = 4, 3


def motion_by(metres):
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = metres
    return pose.expand(2, 4, 4)


class ByTheCar:
    """Queries that are a polyline, carried by exactly the motion of the car."""

    def __call__(self, queries, pose):
        motion = torch.eye(4).repeat(len(pose), 1, 1)
        motion[:, :3, 3] = pose[:, 4:]
        return move_points(queries.unflatten(-1, (POINTS, 2)), plane_motion(motion), ROI).flatten(1)


def read_out(queries):
    logits = torch.tensor([[4.0, -4.0, -4.0]]).expand(len(queries), 3)
    return logits, queries.unflatten(-1, (POINTS, 2))


def loss(lines, labels, metres, tracks=None, motion=None):
    tracks = lines if tracks is None else tracks
    points = lines.unflatten(-1, (-1, 2))
    of_lines, of_classes = transformation_losses(
        motion or ByTheCar(), read_out, tracks, labels, points, motion_by(metres)[: len(tracks)], ROI, PAPER_LOSSES
    )
    return of_lines / (labels < BACKGROUND).sum().clamp(min=1) + of_classes / max(len(labels), 1)


def classes_alone(labels):
    wanted = torch.nn.functional.one_hot(labels, 4)[:, :3].float()
    focal = focal_loss(read_out(torch.zeros(2, 8))[0], wanted).sum() / 2
    return 2 * 0.1 * 5.0 * float(focal)


@pytest.mark.parametrize("metres", [-3.0, 0.0, 6.0])
def test_a_motion_that_moves_queries_as_the_car_moves_loses_nothing(metres):
    lines, labels = torch.rand(2, 2 * POINTS) * 0.5 + 0.25, torch.zeros(2, dtype=torch.int64)
    assert float(loss(lines, labels, metres)) == pytest.approx(classes_alone(labels), rel=1e-4)


def test_a_wrong_place_costs_in_both_directions_unless_it_is_background():
    lines, labels = torch.full((2, 2 * POINTS), 0.5), torch.zeros(2, dtype=torch.int64)
    wrong = lines.clone()
    wrong[1] += 0.05
    # Smooth L1 of 0.05 beyond its square part, for one of two lines, there and back.
    expected = 0.1 * 50 * 2 * (2 * POINTS * (0.05 - 0.005)) / 2 / POINTS
    assert float(loss(lines, labels, 2.0, wrong)) == pytest.approx(classes_alone(labels) + expected, rel=1e-3)
    labels[1] = BACKGROUND
    assert float(loss(lines, labels, 2.0, wrong)) == pytest.approx(classes_alone(labels), rel=1e-4)


def test_what_leaves_the_region_counts_in_neither_direction():
    lines, labels = torch.full((2, 2 * POINTS), 0.5), torch.zeros(2, dtype=torch.int64)
    lines[1, 0::2] = 0.98  # 6 metres further they are out of the region, in x.
    wrong = lines.clone()
    wrong[1, 0::2] -= 0.3
    assert float(loss(lines, labels, 6.0, wrong)) == pytest.approx(classes_alone(labels), rel=1e-4)


def test_it_teaches_the_motion_and_no_track_is_no_loss():
    motion, labels = MotionMlp(2 * POINTS, 16), torch.zeros(2, dtype=torch.int64)
    loss(torch.rand(2, 2 * POINTS), labels, 1.0, motion=motion).backward()
    assert all(parameter.grad.abs().sum() > 0 for parameter in motion.parameters())
    none = torch.zeros(0, 2 * POINTS)
    assert float(loss(none, labels[:0], 1.0, motion=motion)) == 0.0
