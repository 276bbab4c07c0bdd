"""The compiled network says what the network says; without a compiler it is refused at once."""

import os
import shutil

import pytest
import torch

from predmapnet.errors import UserError
from predmapnet.network.kernels.compilation import compile_features
from predmapnet.network.kernels.inference import for_inference
from predmapnet.network.track_selection import select
from tests.predmapnet.network.test_low_precision import case


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lite", "paper-nuscenes"])
@torch.inference_mode()
def test_compiled_agrees(name):
    if shutil.which(os.environ.get("CXX", "g++")) is None:
        pytest.skip("there is no C++ compiler")
    network, inputs = case(name)
    plain, compiled = for_inference(network), for_inference(network)
    compile_features(compiled)
    state = plain.initial_state(1)
    for frame in inputs:
        expected, outputs = plain(frame, state), compiled(frame, state)
        for ours, theirs in zip(outputs.layers[-2:], expected.layers[-2:], strict=True):
            torch.testing.assert_close(ours.points, theirs.points, rtol=0, atol=1e-4)
            torch.testing.assert_close(ours.logits, theirs.logits, rtol=0, atol=1e-4)
        torch.testing.assert_close(outputs.segmentation, expected.segmentation, rtol=0, atol=1e-4)
        selection = select(expected, state, network.config)
        state = plain.advance(state, expected, selection.instances, frame, selection.lost)


def test_without_a_compiler_it_is_refused(monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.raises(UserError, match="C\\+\\+ compiler is needed"):
        compile_features(case("lite")[0])
