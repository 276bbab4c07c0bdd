"""No tensor is made on the wrong device: streams and training steps on a GPU, traced with fake tensors without one."""

from dataclasses import replace

import pytest
import torch

from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.network.calibration import calibrate, collate_calibrations
from predmapnet.network.maptracker.resnet import ResNet50Pyramid
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.network.state import BevFeatures
from predmapnet.network.track_selection import select
from predmapnet.training.data.batches import Batch, StreamSegment
from predmapnet.training.data.targets import Targets
from predmapnet.training.instants import StageTraining
from predmapnet.training.optimiser import WeightAverage, make_optimiser
from predmapnet.training.settings import LITE_STAGES, NUSCENES_STAGES, OptimiserSettings, TrackRules
from tests.predmapnet.pretended_gpu import pretended_gpu
from tests.predmapnet.small_networks import SIZE, PlainBackbone, small_config, two_cameras

STREAMS, FRAMES = 2, 3


def network_of(config):
    """An untrained network whose every row is confident enough for a track; what a ResNet does is tested by itself."""
    torch.manual_seed(0)
    network = PredMapNet(config).train()
    if config.bev.kind == "bevformer":
        network.image_backbone = PlainBackbone(config.bev.width)
    for name, parameter in network.named_parameters():
        if name.endswith("classify.bias"):
            torch.nn.init.constant_(parameter, 0.5)
    return network


def cameras_of(config):
    is_lite = config.bev.kind == "lookup"
    return collate_calibrations([calibrate(DEMO_RIG, config) if is_lite else two_cameras()] * STREAMS)


def instant(config, number, size, cameras):
    """One frame of two streams, with the same three elements in each."""
    pieces, points = 3 * STREAMS, config.decoder.points
    generator = torch.Generator().manual_seed(number)
    poses = torch.eye(4, dtype=torch.float64).repeat(STREAMS, 1, 1)
    poses[:, 0, 3] = 1000.0 + 2.0 * number
    masks = torch.zeros(pieces, 100, 200)
    masks[:, 40:60] = 1.0
    return Batch(
        images=torch.randint(0, 255, (STREAMS, cameras, *size, 3), dtype=torch.uint8, generator=generator),
        camera_valid=torch.ones(STREAMS, cameras, dtype=torch.bool),
        ego_to_global=poses,
        calibration=cameras_of(config),
        targets=Targets(
            batch=STREAMS,
            frame=torch.arange(STREAMS).repeat_interleave(3),
            kinds=torch.tensor([0, 1, 2] * STREAMS),
            element_ids=torch.arange(pieces),
            points=torch.rand(pieces, points, 2, generator=generator),
            masks=masks,
            segmentation=masks.view(STREAMS, 3, 100, 200),
        ),
        depth=torch.randint(-1, config.depth.bins, (STREAMS, cameras, size[0] // 8, size[1] // 8), generator=generator),
    )


def optimise(network, terms, gpu):
    """One step of the optimiser and of the average; every gradient and weight is on the GPU."""
    settings = OptimiserSettings()
    optimiser, average = make_optimiser(network, settings), WeightAverage(network, 0.9)
    torch.stack(list(terms.values())).sum().backward()
    assert all(p.grad.device == gpu.device for p in network.parameters() if p.grad is not None)
    norm = torch.nn.utils.clip_grad_norm_(network.parameters(), settings.clip_norm)
    assert norm.device == gpu.device
    assert float(norm) > 0.0
    optimiser.step()
    average.update(network)
    assert all(value.device == gpu.device for value in average.network.state_dict().values())


@pytest.mark.parametrize("name", ["lite", "maptracker-nuscenes", "paper-nuscenes"])
def test_a_stream_stays_on_the_gpu(name):
    is_lite = name == "lite"
    config = small_config(name)
    size, cameras = ((24, 64), 6) if is_lite else (SIZE, 2)
    network = network_of(config).eval()
    frames = [instant(config, number, size, cameras) for number in range(FRAMES)]
    with pretended_gpu() as gpu, torch.no_grad():
        gpu.put_network(network)
        state = None
        for frame in frames:
            inputs = frame.inputs(network)
            outputs = network(inputs, state)
            selection = select(outputs, state, config)
            state = network.advance(state, outputs, selection.instances, inputs, selection.lost)
            made = [outputs.queries, outputs.segmentation, outputs.bev, *vars(selection.detections).values()]
            assert all(value.device == gpu.device for value in [*made, *state.tensors().values()])
        assert state.instances.valid.any(), "there were tracks"


@pytest.mark.parametrize("stage", NUSCENES_STAGES, ids=lambda stage: stage.name)
def test_a_training_step_of_the_papers_network_stays_on_the_gpu(stage):
    config = small_config("paper-nuscenes")
    network = network_of(config)
    frames = [instant(config, number, SIZE, 2) for number in range(FRAMES)]
    training = StageTraining(network, stage)
    with pretended_gpu() as gpu:
        gpu.put_network(training)
        terms = training(StreamSegment(frames), 1000)
        assert all(term.device == gpu.device for term in terms.values())
        assert ("transformation" in terms) == stage.vectors
        optimise(network, terms, gpu)


def test_a_training_step_of_a_resnet_stays_on_the_gpu():
    torch.manual_seed(0)
    network = ResNet50Pyramid(16).train()
    with pretended_gpu() as gpu:
        gpu.put_network(network)
        levels = network(gpu.put(torch.randn(1, 3, 64, 64)))
        assert all(level.device == gpu.device for level in levels)
        sum(level.sum() for level in levels).backward()
        assert all(p.grad.device == gpu.device for p in network.parameters() if p.grad is not None)


def test_a_training_step_of_lite_streams_stays_on_the_gpu():
    config = small_config("lite")
    network = network_of(config)
    stage = replace(LITE_STAGES[1], tracks=TrackRules(score=0.05))
    frames = [instant(config, number, (24, 64), 6) for number in range(FRAMES)]
    rows, columns = config.bev.rows, config.bev.columns
    features = BevFeatures(
        [
            torch.randn(STREAMS, width, -(-rows // s), -(-columns // s))
            for width, s in zip(config.bev.widths, (1, 2, 4), strict=True)
        ]
    )
    fresh = torch.tensor([True, False])
    clip = StreamSegment(frames, [features] * FRAMES, fresh, replace(frames[0].targets))
    with pretended_gpu() as gpu:
        training = StageTraining(network, stage)
        gpu.put_network(training)
        for step in range(2):
            terms = training(clip, step)
        assert all(term.device == gpu.device for term in terms.values())
        carried = {name: value for name, value in training.tensors().items() if name.startswith("state")}
        assert all(value.device == gpu.device for value in carried.values())
        assert float(terms["forecast"]) > 0.0, "there were tracks"
        optimise(network, terms, gpu)


def test_a_tensor_on_the_wrong_device_is_found():
    with pretended_gpu() as gpu:
        here = gpu.put(torch.arange(3.0))
        assert float((here + 1.0).sum()) == 6.0
        assert here.cpu().numpy().tolist() == [0.0, 1.0, 2.0]
        with pytest.raises(RuntimeError, match="device"):
            _ = here + torch.ones(3)
