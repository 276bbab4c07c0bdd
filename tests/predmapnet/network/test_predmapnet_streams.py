"""The whole network: switches, streams, masks of who sees whom, gradients."""

from dataclasses import replace

import pytest
import torch

from predmapnet.network.predmapnet import PredMapNet
from predmapnet.network.track_selection import instances_from_rows
from tests.predmapnet.small_networks import small_config

MODULES = {
    "history_map": {"history_map": {"guidance": False, "memory": False}},
    "future": {"future": {"enabled": False}},
    "temporal_bev": {"bev": {"memory": {"enabled": False}}},
    "depth": {"depth": {"enabled": False}},
}


def keep_rows(outputs, count, first_id=0):
    """The first ``count`` detection rows become tracks."""
    tracks = int((outputs.query_track_ids[0] >= 0).sum())
    rows = torch.arange(tracks, tracks + count).expand(len(outputs.query_valid), count)
    return instances_from_rows(outputs, rows, rows >= 0, torch.arange(first_id, first_id + count).expand_as(rows))


def tracked_state(network, make_inputs, count=3, batch=1):
    inputs = make_inputs(batch)
    outputs = network(inputs)
    return network.advance(None, outputs, keep_rows(outputs, count), inputs)


def everything(outputs):
    tensors = [outputs.queries, outputs.segmentation]
    for layer in outputs.layers:
        tensors += [tensor for tensor in (layer.logits, layer.points, layer.masks) if tensor is not None]
    return tensors


def wake(network, seed=5):
    """Give zero-initialised branches weights, as training would."""
    generator = torch.Generator().manual_seed(seed)
    for parameter in network.parameters():
        if parameter.abs().max() == 0:
            parameter.data.normal_(0, 0.2, generator=generator)


@pytest.mark.parametrize("module", MODULES)
@torch.no_grad()
def test_a_new_module_starts_without_any_effect(module, make_network, make_inputs):
    """Bit-equal to a network that is built without it, over three frames with tracks."""
    full = make_network(history_map={"threshold": 0.1}, depth={"enabled": True})
    sections = {"history_map": {"threshold": 0.1}, "depth": {"enabled": True}} | MODULES[module]
    without = make_network(seed=1, **sections)
    parameters = full.state_dict()
    without.load_state_dict({name: parameters[name] for name in without.state_dict()})
    assert len(without.state_dict()) < len(parameters)
    states = {full: None, without: None}
    for number in range(3):
        inputs = make_inputs(2, seed=number, x=2.5 * number)
        results = {}
        for network, state in states.items():
            results[network] = network(inputs, state)
            states[network] = network.advance(state, results[network], keep_rows(results[network], 3), inputs)
        for one, other in zip(everything(results[full]), everything(results[without]), strict=True):
            assert torch.equal(one, other)


@pytest.mark.parametrize("sections", [{"semantic_queries": {"enabled": False}, **MODULES["history_map"]}, {}])
@torch.no_grad()
def test_masks_exist_only_where_a_module_needs_them(sections, make_network, make_inputs):
    network = make_network(**sections)
    outputs = network(make_inputs())
    assert (outputs.layers[-1].masks is None) == bool(sections)
    state = network.advance(None, outputs, keep_rows(outputs, 2), make_inputs())
    assert network(make_inputs(x=1.0), state).layers[-1].points.shape == (1, 10, 6, 2)


@torch.no_grad()
def test_the_larger_decoder_works_on_the_lighter_encoder(make_inputs):
    decoder = {"kind": "maptracker", "queries": 8, "points": 6, "width": 32, "heads": 4, "layers": 2, "hidden": 32}
    network = PredMapNet(small_config("lite", decoder=decoder)).eval()
    state = None
    for number in range(3):
        inputs = make_inputs(2, seed=number, x=2.0 * number)
        outputs = network(inputs, state)
        state = network.advance(state, outputs, keep_rows(outputs, 3), inputs)
    assert all(torch.isfinite(tensor).all() for tensor in everything(outputs))
    assert state.vector_memory.valid.sum(dim=-1).tolist() == [[3, 3, 3]] * 2


@torch.no_grad()
def test_an_empty_state_is_the_same_as_none(network, make_inputs):
    wake(network)
    inputs = make_inputs(2)
    alone, empty = network(inputs), network(inputs, network.initial_state(2))
    assert all(torch.equal(one, other) for one, other in zip(everything(alone), everything(empty), strict=True))


@torch.no_grad()
def test_detections_never_see_tracks_one_way_but_do_when_tracks_suppress(make_network, make_inputs):
    for assignment, differs in (("one_way", False), ("suppress", True)):
        network = make_network(bev={"memory": {"enabled": False}}, decoder={"query_assignment": assignment})
        wake(network)
        inputs = make_inputs(x=1.0)
        state = tracked_state(network, make_inputs)
        alone, beside = network(inputs), network(inputs, state)
        gap = (alone.layers[-1].points - beside.layers[-1].points[:, 3:]).abs().max()
        assert (gap > 1e-4) == differs, assignment


@torch.no_grad()
def test_tracks_see_detections_and_each_other(network, make_inputs):
    wake(network)
    state = tracked_state(network, make_inputs)
    changed = replace(state, instances=replace(state.instances, queries=state.instances.queries.clone()))
    changed.instances.queries[:, 2] += 1.0
    before, after = network(make_inputs(x=1.0), state), network(make_inputs(x=1.0), changed)
    assert (before.layers[-1].points - after.layers[-1].points)[:, 0].abs().max() > 1e-6


@torch.no_grad()
def test_padding_of_a_stream_with_fewer_tracks_changes_nothing(network, make_inputs):
    wake(network)
    state = tracked_state(network, make_inputs, count=4, batch=2)
    valid = torch.tensor([[True] * 4, [True, True, False, False]])
    ids = state.instances.track_ids.masked_fill(~valid, -1)
    ragged = replace(state, instances=replace(state.instances, valid=valid, track_ids=ids))
    inputs = make_inputs(2, x=1.5)
    outputs = network(inputs, ragged)
    assert outputs.query_valid.tolist() == [[True] * 12, [True, True, False, False, *[True] * 8]]

    short = state.tensors()
    for name, value in short.items():
        short[name] = value[1:]
        if name.startswith(("instances.", "history_maps", "point_history", "forecasts")):
            short[name] = value[1:, :2]
    car = type(inputs.calibration)(**{name: value[1:] for name, value in vars(inputs.calibration).items()})
    one = type(inputs)(inputs.images[1:], inputs.camera_valid[1:], inputs.ego_to_global[1:], car)
    alone = network(one, type(state).from_tensors(short))
    rows = [0, 1, *range(4, 12)]
    torch.testing.assert_close(outputs.layers[-1].points[1:, rows], alone.layers[-1].points, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(outputs.layers[-1].logits[1:, rows], alone.layers[-1].logits, atol=1e-4, rtol=1e-4)


@torch.no_grad()
def test_a_track_that_left_the_roi_is_no_longer_a_row(network, make_inputs):
    state = tracked_state(network, make_inputs)
    outputs = network(make_inputs(x=200.0), state)
    assert not outputs.query_valid[:, :3].any()
    assert torch.isfinite(outputs.layers[-1].points).all()


@pytest.mark.parametrize("training", [False, True])
@torch.no_grad()
def test_what_a_masked_camera_saw_changes_nothing(training, network, make_inputs):
    network.train(training)
    inputs = make_inputs(2)
    inputs.camera_valid[:, 2] = False
    before = network(inputs)
    inputs.images[:, 2] = float("nan")
    after = network(inputs)
    assert all(torch.equal(one, other) for one, other in zip(everything(before), everything(after), strict=True))
    inputs.images[:, 0] += 1.0
    assert not torch.equal(network(inputs).segmentation, before.segmentation)


@torch.no_grad()
def test_all_cameras_missing_still_gives_finite_numbers(network, make_inputs):
    inputs = make_inputs()
    inputs.camera_valid[:] = False
    assert all(torch.isfinite(tensor).all() for tensor in everything(network(inputs)))


def test_gradient_reaches_every_parameter_of_every_module(make_network, make_inputs):
    network = make_network(depth={"enabled": True}, history_map={"threshold": 0.0}).train()
    wake(network)
    state, total = None, torch.zeros(())
    generator = torch.Generator().manual_seed(1)
    for number in range(3):
        inputs = make_inputs(2, seed=number, x=2.0 * number)
        outputs = network(inputs, state)
        state = network.advance(state, outputs, keep_rows(outputs, 5, first_id=10 * number), inputs)
        for tensor in [*everything(outputs), outputs.depth, state.forecasts]:
            total = total + (tensor * torch.randn(tensor.shape, generator=generator)).mean()
    total.backward()
    gradients = {name: parameter.grad for name, parameter in network.named_parameters()}
    assert [name for name, gradient in gradients.items() if gradient is None] == []
    # A bias of attention keys adds the same to all scores of a query, which softmax does not see.
    still = [name for name, gradient in gradients.items() if gradient.abs().max() == 0 and "key.bias" not in name]
    assert still == []


@torch.no_grad()
def test_the_state_survives_saving_and_gives_the_same_next_frame(network, make_inputs, tmp_path):
    from safetensors.torch import load_file, save_file

    wake(network)
    state = tracked_state(network, make_inputs, batch=2)
    named = {name: tensor.contiguous().clone() for name, tensor in state.tensors().items()}
    save_file(named, tmp_path / "state.safetensors")
    restored = type(state).from_tensors(load_file(tmp_path / "state.safetensors"))
    inputs = make_inputs(2, x=1.0)
    pairs = zip(everything(network(inputs, state)), everything(network(inputs, restored)), strict=True)
    assert all(torch.equal(one, other) for one, other in pairs)


@torch.no_grad()
def test_forward_and_advance_leave_the_old_state_as_it_was(network, make_inputs):
    state = tracked_state(network, make_inputs)
    before = {name: tensor.clone() for name, tensor in state.tensors().items()}
    inputs = make_inputs(x=3.0)
    outputs = network(inputs, state)
    network.advance(state, outputs, keep_rows(outputs, 2, first_id=7), inputs)
    assert all(torch.equal(before[name], tensor) for name, tensor in state.tensors().items())
