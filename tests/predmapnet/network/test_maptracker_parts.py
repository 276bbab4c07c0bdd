"""Parts of the baseline against plain twins, and rules that need no fixtures."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor

from predmapnet.config import DecoderQuirks, EncoderQuirks
from predmapnet.network.ego_motion import invert_pose, quaternion
from predmapnet.network.kernels.deformable_attention import deformable_attention
from predmapnet.network.kernels.deformable_convolution import DeformableConvolution
from predmapnet.network.kernels.normalised_convolution import NormalisedConvolution
from predmapnet.network.maptracker.bev_memory import warp_grid
from predmapnet.network.maptracker.strided_selection import select_strided
from tests.predmapnet.small_networks import (
    frames,
    small_config,
    small_network,
    step,
    together,
)

SMALL = small_config()
QUERIES = SMALL.decoder.queries
NO_QUIRKS = small_config(bev={"quirks": EncoderQuirks().model_dump()}, decoder={"quirks": DecoderQuirks().model_dump()})


def plain_deformable_convolution(convolution: DeformableConvolution, features: Tensor) -> Tensor:
    """Tap by tap with grid_sample."""
    _, _, height, width = features.shape
    moves = convolution.offsets(features)
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    total = 0.0
    for tap in range(9):
        y = rows + tap // 3 - 1 + moves[:, 2 * tap]
        x = columns + tap % 3 - 1 + moves[:, 2 * tap + 1]
        grid = torch.stack([(2 * x + 1) / width - 1, (2 * y + 1) / height - 1], dim=-1)
        sampled = F.grid_sample(features, grid, align_corners=False) * moves[:, 18 + tap, None].sigmoid()
        total = total + torch.einsum("oc,nchw->nohw", convolution.weight[:, :, tap // 3, tap % 3], sampled)
    return total


def test_deformable_convolution_equals_its_plain_twin_and_its_gradients():
    torch.manual_seed(1)
    convolution = DeformableConvolution(6, 8).double()
    torch.nn.init.normal_(convolution.offsets.weight, std=0.3)
    features = torch.randn(2, 6, 7, 9, dtype=torch.float64, requires_grad=True)
    outputs = [convolution(features), plain_deformable_convolution(convolution, features)]
    torch.testing.assert_close(*outputs)
    weights = torch.randn_like(outputs[0])
    inputs = [features, *convolution.parameters()]
    fast, plain = (torch.autograd.grad((output * weights).sum(), inputs) for output in outputs)
    for one, other in zip(fast, plain, strict=True):
        torch.testing.assert_close(one, other)


def test_deformable_attention_equals_grid_sample():
    torch.manual_seed(2)
    sizes, heads, width, queries, samples = [(6, 8), (3, 4)], 2, 5, 7, 3
    values = torch.randn(6 * 8 + 3 * 4, heads, width, dtype=torch.float64)
    x, y = (torch.rand(queries, heads, 2, samples, dtype=torch.float64) * 10 - 1 for _ in range(2))
    weights = torch.rand(queries, heads, 2, samples, dtype=torch.float64)
    found = deformable_attention(values, torch.zeros(queries, dtype=torch.int32), x, y, weights, sizes)
    expected, first = torch.zeros(heads, width, queries, dtype=torch.float64), 0
    for level, (rows, columns) in enumerate(sizes):
        level_map = values[first : first + rows * columns].permute(1, 2, 0).unflatten(-1, (rows, columns))
        grid = torch.stack([(2 * x[:, :, level] + 1) / columns - 1, (2 * y[:, :, level] + 1) / rows - 1], dim=-1)
        sampled = F.grid_sample(level_map, grid.transpose(0, 1), align_corners=False)
        expected += (sampled * weights[:, :, level].transpose(0, 1)[:, None]).sum(dim=-1)
        first += rows * columns
    torch.testing.assert_close(found, expected.permute(2, 0, 1).flatten(1))


@pytest.mark.parametrize(("kernel", "stride"), [(1, 1), (1, 2), (3, 1), (7, 2)])
def test_folded_norm_equals_convolution_then_norm(kernel, stride):
    torch.manual_seed(3)
    unit = NormalisedConvolution(4, 6, kernel, stride).double().eval()
    unit.norm.running_mean.normal_()
    unit.norm.running_var.uniform_(0.5, 2.0)
    features = torch.randn(2, 4, 9, 11, dtype=torch.float64)
    torch.testing.assert_close(unit(features), unit.norm(unit.convolution(features)))


@given(st.tuples(*[st.floats(-4, 4)] * 3))
@settings(max_examples=50, deadline=None)
def test_quaternions_are_those_of_scipy(vector):
    rotation = Rotation.from_rotvec(vector)
    found = quaternion(torch.from_numpy(rotation.as_matrix())).numpy()
    expected = rotation.as_quat()
    assert np.abs(found - expected * np.sign(expected @ found)).max() < 1e-7
    assert found[np.abs(found).argmax()] > 0


def test_inverse_pose_undoes_the_pose():
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.from_numpy(Rotation.from_rotvec([0.1, -0.2, 2.0]).as_matrix())
    pose[:3, 3] = torch.tensor([5.0, -3.0, 1.0])
    torch.testing.assert_close(invert_pose(pose) @ pose, torch.eye(4, dtype=torch.float64))


def plain_choice(travelled: list[float], fallback: str) -> list[int]:
    """The rule of the strided selection, entry by entry."""
    if len(travelled) <= 4:
        return list(range(len(travelled)))
    order = sorted(range(len(travelled)), key=lambda index: travelled[index])
    left, picks = list(order), []
    for distance in (15.0, 10.0, 5.0, 1.0):
        far = [index for index in left if travelled[index] >= distance]
        if far:
            picks.append(far[0])
            left = left[: left.index(far[0])]
        elif left:
            picks.append(left.pop())
        else:
            latest = list(range(len(travelled)))[-4:]
            return latest if fallback == "latest" else order[:4][::-1]
    return picks


@given(
    st.lists(st.floats(0, 30), min_size=1, max_size=9),
    st.integers(0, 3),
    st.sampled_from(["latest", "nearest"]),
)
@settings(max_examples=300, deadline=None)
def test_history_is_chosen_as_the_plain_rule_says(travelled, unused, fallback):
    distances = torch.tensor([[0.0] * unused + travelled])
    valid = torch.tensor([[False] * unused + [True] * len(travelled)])
    slots, chosen = select_strided(distances, valid, (1.0, 5.0, 10.0, 15.0), fallback)
    assert (slots[0][chosen[0]] - unused).tolist() == plain_choice(distances[0, unused:].tolist(), fallback)
    assert slots.shape[1] == min(4, len(travelled) + unused)


def test_without_the_quirk_the_warp_by_no_motion_changes_nothing():
    still = torch.eye(4, dtype=torch.float64)[None]
    maps = torch.rand(1, 3, SMALL.bev.rows, SMALL.bev.columns)
    plain = F.grid_sample(maps, warp_grid(still, NO_QUIRKS), align_corners=False)
    torch.testing.assert_close(plain, maps, atol=1e-5, rtol=0)
    zoomed = F.grid_sample(maps, warp_grid(still, SMALL), align_corners=False)
    assert (zoomed - maps).abs().max() > 0.1


@torch.no_grad()
def test_a_track_moves_against_the_car_and_stays_on_the_border():
    """The car drives 6 m forward: a point 6 m ahead is now here; what leaves the region stays on its border."""
    network = small_network(small_config(decoder={"quirks": {"tracks_moved_from_chosen_history": False}}))
    first, second = frames(2, 0, step=6.0)
    _, state = step(network, first, None)
    state.instances.points[0, 0, :2] = torch.tensor([[0.6, 0.5], [0.05, 0.25]])
    carried = network.propagation(state, second.ego_to_global)
    torch.testing.assert_close(carried.points[0, 0, :2], torch.tensor([[0.5, 0.5], [0.0, 0.25]]))


@pytest.mark.parametrize("config", [SMALL, NO_QUIRKS], ids=["quirks", "no quirks"])
@torch.no_grad()
def test_streams_side_by_side_give_what_each_gives_alone(config):
    network = small_network(config)
    streams = [frames(7, seed) for seed in (0, 1)]
    alone = []
    for stream in streams:
        state, results = None, []
        for inputs in stream:
            outputs, state = step(network, inputs, state)
            results.append((outputs.layers[-1].points[0, -QUERIES:], state.instances.track_ids[0].tolist()))
        alone.append(results)
    assert any(len(ids) for results in alone for _, ids in results[1:])
    state = None
    for number in range(7):
        outputs, state = step(network, together([stream[number] for stream in streams]), state)
        for stream in range(2):
            points, ids = alone[stream][number]
            torch.testing.assert_close(outputs.layers[-1].points[stream, -QUERIES:], points, atol=2e-4, rtol=0)
            assert state.instances.track_ids[stream][state.instances.valid[stream]].tolist() == ids


@torch.no_grad()
def test_a_step_leaves_the_state_that_went_in_as_it_was():
    network, inputs = small_network(SMALL), frames(3, 0)
    _, state = step(network, inputs[0], None)
    _, state = step(network, inputs[1], state)
    first, _ = step(network, inputs[2], state)
    again, _ = step(network, inputs[2], state)
    torch.testing.assert_close(first.queries, again.queries, atol=0, rtol=0)


@torch.no_grad()
def test_memory_keeps_no_more_than_its_capacity():
    network, state = small_network(SMALL), None
    for inputs in frames(9, 0):
        _, state = step(network, inputs, state)
    assert state.bev_memory.shape[1] == SMALL.bev.memory.capacity
    assert state.vector_memory.valid.shape[2] == SMALL.decoder.memory_capacity
    ages = (state.frame[:, None, None] - state.vector_memory.frames)[state.vector_memory.valid]
    assert ages.max() <= SMALL.decoder.memory_capacity
    assert (state.vector_memory.valid.sum(dim=-1) >= 1).all()
