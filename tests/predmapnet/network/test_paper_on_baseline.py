"""The paper's modules on MapTracker's baseline: each with its switch, none of them in the way of another."""

import pytest
import torch

from predmapnet.config import DecoderQuirks, EncoderQuirks
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.network.state import StreamState
from predmapnet.network.track_selection import instances_from_rows
from tests.predmapnet.small_networks import frames, small_config, small_network, step, together

OFF = {
    "semantic_queries": {"enabled": False},
    "history_map": {"memory": False, "guidance": False},
    "future": {"enabled": False},
    "depth": {"enabled": False},
}
ALONE = {
    "none": {},
    "semantic_queries": {"semantic_queries": {"enabled": True}},
    "history memory": {"history_map": {"memory": True, "guidance": False}},
    "history guidance": {"history_map": {"memory": True, "guidance": True}},
    "future": {"future": {"enabled": True}},
    "depth": {"depth": {"enabled": True}},
}
TRACKS = {"tracking": {"tau_t": 0.0, "tau_d": 0.52, "first_tau_d": 0.4}}


def tensors(outputs):
    named = {"queries": outputs.queries, "segmentation": outputs.segmentation, "bev": outputs.bev}
    for number, layer in enumerate(reversed(outputs.layers)):
        named |= {f"logits {number}": layer.logits, f"points {number}": layer.points}
    return {name: value for name, value in named.items() if value is not None}


def stream(network, count=3):
    state, results = None, []
    for inputs in zip(frames(count, 0), frames(count, 1), strict=True):
        outputs, state = step(network, together(list(inputs)), state)
        results.append(outputs)
    return results, state


@pytest.mark.parametrize("module", ALONE)
@torch.no_grad()
def test_each_module_works_without_the_others(module):
    config = small_config("paper-nuscenes", **TRACKS, **{**OFF, **ALONE[module]})
    results, state = stream(PredMapNet(config).eval())
    assert state.instances.valid.any(dim=1).all()
    for outputs in results:
        assert all(torch.isfinite(value).all() for value in tensors(outputs).values())
    masks = results[-1].layers[-1].masks
    assert (masks is None) == (module in ("none", "future", "depth"))
    assert len(results[-1].layers) == 2 + 4 * (module == "semantic_queries")


@pytest.mark.parametrize("module", [name for name in ALONE if name not in ("none", "semantic_queries")])
@torch.no_grad()
def test_a_new_module_leaves_the_tracks_of_the_baseline_as_they_are(module):
    """Bit-equal to the baseline over three frames with tracks, with weights of the baseline."""
    baseline = small_network(small_config(**TRACKS))
    section = {**ALONE[module]}
    if "history_map" in section:
        section["history_map"] = {**section["history_map"], "threshold": 0.01}
    with_module = small_network(small_config(**TRACKS, **section), seed=1)
    missing, unexpected = with_module.load_state_dict(baseline.state_dict(), strict=False)
    assert not unexpected and bool(missing) == (with_module.state_dict().keys() != baseline.state_dict().keys())
    results, state = stream(baseline)
    again, state_again = stream(with_module)
    assert state.instances.valid.any()
    assert torch.equal(state.instances.track_ids, state_again.instances.track_ids)
    for one, other in zip(results, again, strict=True):
        ours = tensors(other)
        assert all(torch.equal(value, ours[name]) for name, value in tensors(one).items())


@torch.no_grad()
def test_weights_of_the_baseline_fill_all_but_the_new_modules():
    whole = PredMapNet(small_config("paper-nuscenes"))
    missing, unexpected = whole.load_state_dict(PredMapNet(small_config()).state_dict(), strict=False)
    assert not unexpected
    new = {"query_generator", "bev_pyramid", "mask_head", "history_guidance", "future_guidance", "depth_head"}
    assert {name.split(".")[0] for name in missing} == new
    kept = ("query_generator.content", "query_generator.first_guess")
    assert not [name for name in missing if name.startswith(kept)]


@pytest.mark.parametrize("quirks", [True, False])
def test_gradient_reaches_every_parameter(quirks):
    """Over a clip of three frames; the motion perceptron learns from a loss of its own (MapTracker's)."""
    bev, decoder = ({"quirks": dict.fromkeys(part.model_fields, quirks)} for part in (EncoderQuirks, DecoderQuirks))
    config = small_config("paper-nuscenes", history_map={"threshold": 0.0}, bev=bev, decoder=decoder)
    network = small_network(config).train()
    for parameter in network.parameters():
        if not parameter.any():
            torch.nn.init.normal_(parameter, std=0.1)
    state, loss = None, torch.zeros(())
    for number, both in enumerate(zip(frames(3, 0), frames(3, 1), strict=True)):
        inputs = together(list(both))
        outputs = network(inputs, state)
        count = outputs.query_valid.shape[1]
        rows = torch.arange(count - 4, count).expand(2, -1)
        instances = instances_from_rows(outputs, rows, rows >= 0, torch.arange(4).expand(2, -1) + 2 * number)
        state = network.advance(state, outputs, instances, inputs)
        parts = [outputs.segmentation, outputs.depth, state.forecasts]
        for layer in outputs.layers:
            parts += [value for value in (layer.logits, layer.points, layer.masks) if value is not None]
        pose = torch.randn(2, 4, 7)
        parts += network.map_decoder.read_out(network.propagation.motion(state.instances.queries, pose))
        loss = loss + sum((part - 0.3).square().mean() for part in parts)
    loss.backward()
    # The fourth code of the image levels is never used; a bias of keys adds the same to all scores of a query.
    untouched = [name for name, value in network.named_parameters() if value.grad is None or not value.grad.any()]
    assert [name for name in untouched if "key.bias" not in name] == []


@torch.no_grad()
def test_the_state_as_named_tensors_gives_the_same_next_frame():
    network = small_network(small_config("paper-nuscenes", **TRACKS))
    _, state = stream(network)
    restored = StreamState.from_tensors({name: value.clone() for name, value in state.tensors().items()})
    assert restored.vector_memory.valid.any() and restored.frame.tolist() == [3, 3]
    inputs = together([frames(4, seed)[3] for seed in (0, 1)])
    one, other = (tensors(step(network, inputs, before)[0]) for before in (state, restored))
    assert all(torch.equal(value, other[name]) for name, value in one.items())


@pytest.mark.parametrize("training", [False, True])
@torch.no_grad()
def test_a_masked_camera_reaches_nothing(training):
    network = small_network(small_config("paper-nuscenes")).train(training)
    inputs = frames(1, 0)[0]
    inputs.camera_valid[0, 1] = False
    torch.manual_seed(1)
    before = tensors(step(network, inputs, None)[0])
    inputs.images[0, 1] = torch.nan
    torch.manual_seed(1)
    after = tensors(step(network, inputs, None)[0])
    assert all(torch.equal(value, after[name]) for name, value in before.items())


POINTS = {"kind": "points", "queries": 12, "points": 5, "width": 32, "heads": 4, "layers": 2}
MIXED = {
    "points decoder on bevformer": {
        "decoder": {**POINTS, "query_assignment": "suppress"},
    },
    "one way": {
        "decoder": POINTS,
        "bev": {"quirks": dict.fromkeys(EncoderQuirks.model_fields, False)},
        "tracking": {"merge": True, "tau_d": 0.04, "tau_t": 0.03},
    },
}


@pytest.mark.parametrize("sections", MIXED.values(), ids=MIXED)
@torch.no_grad()
def test_the_lighter_decoder_works_on_the_larger_encoder(sections):
    tracking = {"first_tau_d": None, "tau_d": 0.04, "tau_t": 0.0}
    results, state = stream(small_network(small_config("paper-nuscenes", **{"tracking": tracking, **sections})))
    assert state.instances.valid.any() and torch.isfinite(results[-1].queries).all()
