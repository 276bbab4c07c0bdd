"""Results whose classes are numbered in another way lie on the truth of other kinds, and are refused."""

from dataclasses import replace
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest

from predmapnet.errors import UserError
from predmapnet.evaluation.class_order import check_class_order, kinds_found
from tests.predmapnet.evaluation.test_measurement import drive

PATH = Path("results.json")


def labelled(frames, order):
    """The frames with kind ``k`` predicted as ``order[k]``."""
    kinds = np.array(order)
    return [replace(frame, predicted=replace(frame.predicted, kinds=kinds[frame.predicted.kinds])) for frame in frames]


@pytest.mark.parametrize("order", list(permutations(range(3))))
def test_every_other_order_is_refused(order):
    counts = kinds_found(labelled(drive()[0], order))
    assert counts.sum() == 18 and counts[order, range(3)].tolist() == [6, 6, 6]
    if order == (0, 1, 2):
        check_class_order(PATH, counts)
    else:
        with pytest.raises(UserError, match="numbered in another way"):
            check_class_order(PATH, counts)


def test_the_message_names_what_lies_where():
    with pytest.raises(UserError, match="labelled ped_crossing lie on true dividers, elements labelled divider lie on"):
        check_class_order(PATH, kinds_found(labelled(drive()[0], (1, 0, 2))))


def test_labels_from_one_are_refused():
    """Boundaries are of no class then, and have been left out."""
    with pytest.raises(UserError, match="labelled divider lie on true crossings, elements labelled boundary lie on"):
        check_class_order(PATH, np.array([[0, 0, 0], [40, 2, 0], [0, 80, 9]]))


@pytest.mark.parametrize(
    "counts",
    [
        [[0, 0, 0], [0, 0, 0], [0, 0, 0]],
        [[0, 0, 0], [0, 5, 95], [0, 0, 0]],  # a poor network calls kerbs dividers, and finds nothing else
        [[0, 0, 0], [0, 5, 95], [0, 10, 90]],
        [[50, 0, 0], [0, 50, 50], [0, 50, 50]],
        [[0, 4, 0], [4, 0, 0], [0, 0, 4]],  # too few to say
    ],
)
def test_poor_and_few_results_are_measured(counts):
    check_class_order(PATH, np.array(counts))


def test_what_lies_on_no_truth_says_nothing():
    frames, _ = drive(offset=4.0)
    assert kinds_found(frames).sum() == 0
    assert kinds_found([]).sum() == 0
