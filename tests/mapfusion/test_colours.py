"""One colour language: every kind and every change has its colour, and none is taken for another."""

from itertools import combinations

import numpy as np

from mapfusion.colours import BACKGROUND, CHANGE_COLOURS, KIND_COLOURS, web_colour
from mapfusion.diff import Change
from mapfusion.elements import ElementKind


def test_every_kind_and_every_change_has_a_colour_of_its_own():
    assert set(KIND_COLOURS) == set(ElementKind)
    assert set(CHANGE_COLOURS) == set(Change)
    for one, other in combinations([*KIND_COLOURS.values(), *CHANGE_COLOURS.values(), BACKGROUND], 2):
        assert np.linalg.norm(np.subtract(one, other)) > 50, (one, other)


def test_colours_are_written_as_the_web_reads_them():
    assert web_colour((0, 171, 255)) == "#00abff"
