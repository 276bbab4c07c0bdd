"""bfloat16 in the image backbone and the BEV encoder says nearly what float32 says, and touches nothing else."""

import pytest
import torch

from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.machine import Precision
from predmapnet.network.calibration import calibrate
from predmapnet.network.kernels.inference import for_inference
from predmapnet.network.kernels.low_precision import in_precision
from predmapnet.network.state import FrameInputs
from predmapnet.network.track_selection import select
from tests.predmapnet.small_networks import frames, small_config, small_network

FRAMES = 3


def lite_frames(config):
    generator = torch.Generator().manual_seed(0)
    for number in range(FRAMES):
        pose = torch.eye(4, dtype=torch.float64)[None].clone()
        pose[0, 0, 3] = 2.0 * number
        images = torch.randn(1, 6, 3, 24, 64, generator=generator)
        yield FrameInputs(images, torch.ones(1, 6, dtype=torch.bool), pose, calibrate(DEMO_RIG, config))


def case(name):
    """A network and frames for it."""
    if name == "lite":
        network = small_network(small_config(name))
        for parameter in (value for key, value in network.named_parameters() if key.endswith("classify.bias")):
            torch.nn.init.constant_(parameter, 0.5)  # So that there are tracks.
        return network, list(lite_frames(network.config))
    network = small_network(small_config(name))
    return network, frames(FRAMES, seed=0)


@pytest.mark.parametrize("name", ["lite", "maptracker-nuscenes", "paper-nuscenes"])
@torch.inference_mode()
def test_bfloat16_agrees_with_float32(name):
    network, inputs = case(name)
    exact = in_precision(for_inference(network), Precision.FLOAT32)
    low = in_precision(for_inference(network), Precision.BFLOAT16)
    state = exact.initial_state(1)
    for frame in inputs:
        expected, outputs = exact(frame, state), low(frame, state)
        difference = (outputs.segmentation - expected.segmentation).abs().max()
        assert 0 < difference < 0.03 * expected.segmentation.abs().max()
        apart = (outputs.layers[-1].points - expected.layers[-1].points).abs()
        # Masked attention decides cell by cell: at its threshold a query may see a cell more or less.
        assert apart.quantile(0.9) < 0.005
        assert apart.max() < 0.05
        assert (outputs.layers[-1].logits.sigmoid() - expected.layers[-1].logits.sigmoid()).abs().max() < 0.02
        selection = select(outputs, state, network.config)
        after = low.advance(state, outputs, selection.instances, frame, selection.lost)
        assert torch.bfloat16 not in {value.dtype for value in after.tensors().values()}
        selection = select(expected, state, network.config)
        state = exact.advance(state, expected, selection.instances, frame, selection.lost)
    assert state.instances.valid.any(), "there were tracks"


def test_layers_that_say_where_to_look_stay_exact():
    network, _ = case("paper-nuscenes")
    low = in_precision(for_inference(network), Precision.BFLOAT16)
    kinds = {name: parameter.dtype for name, parameter in low.named_parameters()}
    exact = [name for name in kinds if "offsets" in name or "attention_weights" in name or "norms" in name]
    assert exact
    assert {kinds[name] for name in exact} == {torch.float32}
    reduced = {name.split(".")[0] for name, kind in kinds.items() if kind == torch.bfloat16}
    assert reduced == {"image_backbone", "bev_encoder"}
