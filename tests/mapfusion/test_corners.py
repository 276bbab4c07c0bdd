"""Crossings get the four corners that a person would draw, and keep their form where four do not fit."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mapfusion.corners import drawn_outline


def corners_of(polygon):
    return shapely.get_coordinates(polygon)[:-1]


def overlap(one, two):
    one, two = one.buffer(0), two.buffer(0)  # detections may cross themselves
    return one.intersection(two).area / one.union(two).area


@settings(max_examples=80, deadline=None)
@given(
    length=st.floats(6, 18),
    width=st.floats(2.5, 5),
    skew=st.floats(-0.4, 0.4),
    turn=st.floats(0, 6.3),
    round_off=st.floats(0.2, 0.7),
    seed=st.integers(0, 1000),
)
@example(length=18.0, width=2.5, skew=0.0, turn=0.0, round_off=0.25, seed=472)  # few samples on the short sides
@example(length=6.0, width=4.5, skew=-0.25, turn=0.0, round_off=0.3125, seed=359)  # a round's sides swapped places
@example(length=6.0, width=2.5, skew=0.0, turn=0.0, round_off=0.25, seed=537)  # noise lets the outline cross itself
def test_a_rounded_and_noisy_crossing_gets_its_corners_back(length, width, skew, turn, round_off, seed):
    sides = np.array([[0, 0], [length, 0], [length + skew * width, width], [skew * width, width]])
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    true = shapely.Polygon(sides @ rotation.T + [500.0, -300.0])
    rounded = true.buffer(-round_off * width / 3).buffer(round_off * width / 3)
    outline = shapely.segmentize(shapely.simplify(rounded, 0.1).exterior, 1.0)
    noise = np.random.default_rng(seed).normal(0, 0.05, (len(outline.coords) - 1, 2))
    detected = shapely.Polygon(shapely.get_coordinates(outline)[:-1] + noise)
    drawn = drawn_outline(detected)
    assert len(corners_of(drawn)) == 4
    assert overlap(drawn, true) > max(overlap(detected, true) - 0.03, 0.88)
    distance = np.linalg.norm(corners_of(drawn)[:, None] - corners_of(true), axis=2).min(axis=1)
    assert distance.max() < 0.6


@pytest.mark.parametrize(
    "outline",
    [
        shapely.Point(0, 0).buffer(6.0),
        shapely.Polygon([[0, 0], [12, 0], [12, 4], [4, 4], [4, 14], [0, 14]]),
        shapely.Polygon([[0, 0], [9, 0], [0, 6]]),
        shapely.LineString([[0, 0], [8, 0], [14, 6], [15, 14]]).buffer(2.0),
    ],
)
def test_what_has_not_four_corners_keeps_its_form(outline):
    drawn = drawn_outline(outline)
    assert len(corners_of(drawn)) != 4
    assert shapely.hausdorff_distance(drawn.exterior, outline.exterior) < 0.25


def test_four_corners_stay_where_they_are():
    square = shapely.Polygon([[0, 0], [11, 1], [11, 5], [0, 3.5]])
    assert overlap(drawn_outline(square), square) > 0.999
