"""Assignment and losses of the baseline's training give the official values."""

import numpy as np
import pytest
import torch

from predmapnet.training.losses.maptracker import (
    CLASS_WEIGHT,
    LINE_WEIGHT,
    all_orders,
    assign_layer,
    layer_losses,
    line_cost,
    segmentation_losses,
)
from predmapnet.training.losses.matching import focal_class_cost
from tests.predmapnet.network.maptracker_reference import FOLDER, load_reference

pytestmark = pytest.mark.reference
TRACKS = {0: 3, 2: 0}
"""Track row to the truth that it goes on with; of four tracks, the others have none."""


@pytest.fixture(scope="module")
def expected():
    path = FOLDER / "losses_unit.npz"
    if not path.is_file():
        pytest.skip(f"no reference fixtures at {path}: set PREDMAPNET_REFERENCE")
    with np.load(path) as values:
        return {name: torch.from_numpy(np.asarray(value)) for name, value in values.items()}


@pytest.fixture(scope="module")
def given(expected):
    return {name: torch.from_numpy(value) for name, value in load_reference().spec.unit_losses_inputs().items()}


def close(found, wanted):
    torch.testing.assert_close(found, wanted.reshape(found.shape), rtol=1e-5, atol=2e-5)


def test_costs(given, expected):
    count = len(expected["cost"])
    distance, order = line_cost(given["lines"][:count], given["gt_lines"])
    close(distance, expected["reg_cost_unweighted"])
    close(
        CLASS_WEIGHT * focal_class_cost(given["logits"][:count])[:, given["gt_labels"]] + LINE_WEIGHT * distance,
        expected["cost"],
    )
    assert torch.equal(order, expected["best_permutation"])


@pytest.mark.parametrize("case", ["plain", "tracks"])
def test_assignment_and_losses_of_a_layer(given, expected, case):
    count = len(expected[f"{case}/target_labels"])
    logits, lines = given["logits"][:count], given["lines"][:count]
    detection, continued = torch.ones(count, dtype=torch.bool), torch.full((count,), -1)
    valid = torch.ones(count, dtype=torch.bool)
    if case == "tracks":
        detection[:4], detection[104:], valid[104:] = False, False, False
        for row, truth in TRACKS.items():
            continued[row] = truth
    targets = assign_layer(logits, lines, given["gt_lines"], given["gt_labels"], detection, continued)
    assert torch.equal(targets.rows, expected[f"{case}/pos_query"])
    assert torch.equal(targets.truth, expected[f"{case}/pos_gt"])
    assert torch.equal(targets.labels, expected[f"{case}/target_labels"])
    close(targets.lines, expected[f"{case}/target_lines"])
    focal, line = layer_losses(logits, lines, targets, valid)
    close(focal, expected[f"{case}/loss_cls"])
    close(line, expected[f"{case}/loss_reg"])


def test_segmentation_losses(given, expected):
    focal, dice = segmentation_losses(given["seg_logits"], given["seg_target"])
    close(focal, expected["seg_focal"])
    close(dice, expected["seg_dice"])


@pytest.mark.parametrize("kind", [0, 1, 2])
def test_orders_of_the_truth_are_the_official_ones(kind):
    folder = FOLDER.parent / "ground_truth" / "av2" / "gt"
    files = sorted(folder.glob("*.permuted_norm.npz"))
    if not files:
        pytest.skip(f"no reference fixtures at {folder}: set PREDMAPNET_REFERENCE")
    for path in files:
        with np.load(path) as stored:
            arrays = [stored[name] for name in stored.files if name.endswith(f"class{kind}") and len(stored[name])]
        for official in arrays:
            found = all_orders(torch.from_numpy(official[:, 0]), torch.full((len(official),), kind)).numpy()
            for ours, theirs in zip(found, official.reshape(*official.shape[:2], -1), strict=True):
                # The same orders, in whatever order they come; unused ones are far away in both.
                distance = np.abs(ours[:, None] - theirs[None]).max(axis=-1)
                used = np.abs(theirs).max(axis=-1) < 10
                assert (distance.min(axis=0)[used] < 1e-6).all()
                assert (np.abs(ours).max(axis=-1) < 10).sum() >= 2
                assert (distance.min(axis=1)[np.abs(ours).max(axis=-1) < 10] < 1e-6).all()
