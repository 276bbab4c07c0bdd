"""Assignment and losses of the baseline's training give the official values."""

import numpy as np
import pytest
import torch

from predmapnet.network.state import FrameOutputs, LayerPredictions
from predmapnet.training.data.targets import Targets
from predmapnet.training.losses.frame import LossSums, add_layers
from predmapnet.training.losses.matching import Truth, focal_class_cost, line_costs, match
from predmapnet.training.losses.terms import segmentation_losses
from predmapnet.training.losses.weights import PAPER_LOSSES
from predmapnet.training.track_truth import TrackTruth
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


class OfficialTruth(Truth):
    """Truth whose orders are the official ones."""

    def __init__(self, orders, labels):
        points = orders[:, 0].unflatten(-1, (-1, 2))
        count = len(points)
        zeros = torch.zeros(count, dtype=torch.int64)
        targets = Targets(
            1, zeros, labels, torch.arange(count), points, torch.zeros(count, 1, 1), torch.zeros(1, 3, 1, 1)
        )
        super().__init__(targets, torch.device("cpu"), torch.ones(2))
        self.official = orders

    def orders(self):
        pieces, orders = self.official.shape[:2]
        owner = torch.arange(pieces).repeat_interleave(orders)[None]
        return self.official.flatten(0, 1)[None], owner, pieces


def test_costs(given, expected):
    count = len(expected["cost"])
    truth = OfficialTruth(given["gt_lines"], given["gt_labels"])
    distance = line_costs(given["lines"][None, :count], *truth.orders(), PAPER_LOSSES.cost_beta)[0]
    close(2 * distance, expected["reg_cost_unweighted"])
    close(
        PAPER_LOSSES.cost_focal * focal_class_cost(given["logits"][:count])[:, given["gt_labels"]]
        + PAPER_LOSSES.cost_points * distance,
        expected["cost"],
    )


@pytest.mark.parametrize("case", ["plain", "tracks"])
def test_assignment_and_losses_of_a_layer(given, expected, case):
    count = len(expected[f"{case}/target_labels"])
    logits, lines = given["logits"][None, :count], given["lines"][:count].unflatten(-1, (-1, 2))[None]
    truth = OfficialTruth(given["gt_lines"], given["gt_labels"])
    valid = torch.ones(1, count, dtype=torch.bool)
    owners = TrackTruth.none(1)
    if case == "tracks":
        valid[:, 104:] = False
        owners = TrackTruth(*np.full((2, 1, 4), -1))
        for row, piece in TRACKS.items():
            owners.kinds[0, row], owners.element_ids[0, row] = truth.kinds[piece], piece
    outputs = FrameOutputs(
        layers=[LayerPredictions(logits, lines, None)],
        queries=torch.zeros(1, count, 1),
        query_valid=valid,
        query_track_ids=torch.full((1, count), -1),
        segmentation=torch.zeros(1, 3, 1, 1),
        bev=torch.zeros(1, 0, 1, 1),
        ego_to_global=torch.eye(4, dtype=torch.float64)[None],
    )
    matched = match(outputs, truth, owners, PAPER_LOSSES, exclusive=True)
    pairs = matched.layers[-1]
    assert torch.equal(pairs.row, expected[f"{case}/pos_query"])
    assert torch.equal(pairs.truth, expected[f"{case}/pos_gt"])
    labels = torch.full((count,), 3).scatter(0, pairs.row, given["gt_labels"][pairs.truth])
    assert torch.equal(labels, expected[f"{case}/target_labels"])
    sums = LossSums()
    add_layers(sums, outputs, truth, matched, owners.kinds.shape[1], PAPER_LOSSES)
    terms = sums.means(lambda counts: counts)
    close(terms["focal"], expected[f"{case}/loss_cls"])
    close(terms["points"], expected[f"{case}/loss_reg"])


def test_segmentation_losses(given, expected):
    truth = OfficialTruth(given["gt_lines"], given["gt_labels"])
    truth.targets.segmentation = given["seg_target"].float()
    terms = segmentation_losses(given["seg_logits"], truth.targets, PAPER_LOSSES)
    close(terms["segmentation"], expected["seg_focal"])
    close(terms["segmentation_dice"], expected["seg_dice"])


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
            orders = torch.from_numpy(official.reshape(*official.shape[:2], -1)).float()
            lines, owner, _ = Truth.orders(OfficialTruth(orders, torch.full((len(official),), kind)))
            for number, theirs in enumerate(orders.numpy()):
                # The same orders, in whatever order they come; their unused ones are far away.
                ours = lines[0, owner[0] == number].numpy()
                used = np.abs(theirs).max(axis=-1) < 10
                distance = np.abs(ours[:, None] - theirs[None, used]).max(axis=-1)
                assert len(ours) == used.sum() == (38 if kind == 0 else 2)
                assert (distance.min(axis=0) < 1e-6).all() and (distance.min(axis=1) < 1e-6).all()
