"""No tensor of the paper's network is made on the wrong device: a clip on a GPU, traced without one."""

import warnings
from dataclasses import replace

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode

from predmapnet.network.interface import FrameInputs
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.network.tracking import instances_from_rows
from tests.predmapnet.network.small_baseline import SIZE, small_config, small_pillars

TRACKS = 3
GPU = torch.device("privateuseone:0")


@pytest.fixture(scope="module", autouse=True)
def pretended_gpu():
    """A device without kernels, for fake tensors: a build of torch for CPUs refuses to slice fake CUDA tensors."""
    registration = pytest.importorskip("torch.utils.backend_registration")
    if not hasattr(registration, "_setup_privateuseone_for_python_backend"):
        pytest.skip(f"torch {torch.__version__} cannot pretend to have a device")
    registration._setup_privateuseone_for_python_backend()


def on_gpu(value, mode):
    """The same tensor, as if it were on a GPU."""
    return mode.from_tensor(value).detach().to(GPU)


def tracks_of(outputs, batch):
    """The first detections become tracks, as a trainer would choose them."""
    rows = torch.arange(TRACKS, device=GPU).expand(batch, -1)
    first = outputs.row_valid.shape[1] - small_config().decoder.queries
    return instances_from_rows(outputs, first + rows, rows >= 0, rows)


@pytest.mark.parametrize("preset", ["maptracker-nuscenes", "paper-nuscenes"])
def test_the_frames_of_a_training_clip_stay_on_the_gpu(preset):
    config = small_config(preset)
    batch, cameras = 2, len(config.bev.cameras)
    pillars = small_pillars(config)
    assert len(pillars.camera)
    network = PredMapNet(config).train()
    with FakeTensorMode(allow_non_fake_inputs=False) as mode, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for module in network.modules():
            for name, value in list(module.named_parameters(recurse=False)):
                setattr(module, name, torch.nn.Parameter(on_gpu(value, mode)))
            for name, value in list(module.named_buffers(recurse=False)):
                setattr(module, name, on_gpu(value, mode))
        names = ("camera", "cell", "positions", "sees")
        pillars = replace(pillars, **{name: on_gpu(getattr(pillars, name), mode) for name in names})
        state, loss = None, torch.zeros((), device=GPU)
        for _ in range(6):
            inputs = FrameInputs(
                images=torch.zeros(batch, cameras, 3, *SIZE, device=GPU),
                camera_valid=torch.ones(batch, cameras, dtype=torch.bool, device=GPU),
                ego_to_global=torch.eye(4, dtype=torch.float64, device=GPU).expand(batch, 4, 4),
            )
            outputs = network(inputs, pillars, state)
            state = network.advance(state, outputs, tracks_of(outputs, batch), inputs)
            loss = loss + outputs.segmentation.sum() + sum(layer.points.sum() for layer in outputs.layers[-2:])
        assert loss.device == GPU
        assert all(value.device == GPU for value in state.tensors().values())
        assert state.bev_memory.shape[1] == 6
