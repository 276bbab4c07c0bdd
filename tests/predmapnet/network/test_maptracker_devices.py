"""No tensor of the baseline is made on the wrong device: the forward passes of a clip on a GPU, traced without one."""

import warnings
from dataclasses import replace

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode

from predmapnet.network.camera_pillars import make_camera_pillars
from predmapnet.network.interface import FrameInputs, Instances
from predmapnet.network.maptracker import MapTracker
from predmapnet.network.maptracker_config import MapTrackerConfig

SMALL = MapTrackerConfig(
    rows=10, columns=20, bev_width=32, bev_heads=4, decoder_width=32, decoder_heads=4, queries=12, points=5, cameras=2
)
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


def tracks_of(outputs, batch) -> Instances:
    """The first detections become tracks, as a trainer would choose them."""
    last = outputs.layers[-1]
    integers = torch.arange(TRACKS, device=GPU).expand(batch, -1)
    return Instances(
        valid=integers >= 0,
        track_ids=integers,
        labels=integers,
        scores=last.logits[:, -TRACKS:].amax(dim=-1).sigmoid(),
        misses=integers,
        queries=outputs.queries[:, -TRACKS:],
        points=last.points[:, -TRACKS:],
        masks=torch.zeros(batch, TRACKS, 0, 0, device=GPU),
    )


def test_the_frames_of_a_training_clip_stay_on_the_gpu():
    batch, cameras = 2, SMALL.cameras
    ego_to_image = torch.eye(4, dtype=torch.float64).expand(cameras, 4, 4)[:, [1, 2, 0, 3]] * 30
    pillars = make_camera_pillars(ego_to_image, (64, 96), SMALL)
    assert len(pillars.camera)
    network = MapTracker(SMALL).train()
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
                images=torch.zeros(batch, cameras, 3, 64, 96, device=GPU),
                camera_valid=torch.ones(batch, cameras, dtype=torch.bool, device=GPU),
                ego_to_global=torch.eye(4, dtype=torch.float64, device=GPU).expand(batch, 4, 4),
            )
            outputs = network(inputs, pillars, state)
            state = network.advance(state, outputs, tracks_of(outputs, batch), inputs)
            loss = loss + outputs.segmentation.sum() + sum(layer.points.sum() for layer in outputs.layers)
        assert loss.device == GPU
        values = [*vars(state).values(), *vars(state.instances).values(), *vars(state.vector_memory).values()]
        assert all(value.device == GPU for value in values if isinstance(value, torch.Tensor))
        assert state.bev_memory.shape[1] == 6
