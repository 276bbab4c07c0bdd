"""Exported graphs in ONNX Runtime against the network in torch, over drives."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import predmapnet as pmn
from predmapnet.config import PredMapNetConfig
from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.engines import Engine, TorchEngine
from predmapnet.errors import UserError
from predmapnet.export.engine import OnnxEngine
from predmapnet.export.graphs import padded_state
from predmapnet.export.onnx_files import ABOUT, export_graphs, read_graph_folder
from predmapnet.machine import NetworkOptions, Precision
from predmapnet.mapper import Mapper
from predmapnet.network.calibration import calibrate
from predmapnet.network.image_input import input_size
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.network.state import FrameInputs, Instances, StreamState
from predmapnet.presets import preset
from predmapnet.weights.checkpoint import Checkpoint, load_checkpoint
from tests.predmapnet.network.paper_network import tiny_config
from tests.predmapnet.small_networks import opened, small_config

TOLERANCE = 1e-3


def networks_checkpoint(config: PredMapNetConfig) -> Checkpoint:
    """A network with random weights, all branches open, of which some rows become tracks."""
    torch.manual_seed(0)
    network = PredMapNet(config)
    return Checkpoint(opened(network), {"seed": 0}, "test", "0" * 64)


def drive(config: PredMapNetConfig, frames: int) -> Iterator[FrameInputs]:
    """Random images from a car that turns; a camera is lost once, and from the middle on the car has fewer cameras."""
    generator = torch.Generator().manual_seed(1)
    names = getattr(config.bev, "cameras", None)
    for index in range(frames):
        rig = DEMO_RIG
        if names is None and index >= frames // 2:
            rig = rig[:3]
        images = torch.randn(1, len(rig), 3, *input_size(config.image), generator=generator)
        valid = torch.ones(1, len(rig), dtype=torch.bool)
        valid[0, 1] = index != 2
        yaw, pose = torch.tensor(0.05 * index, dtype=torch.float64), torch.eye(4, dtype=torch.float64)[None]
        pose[0, 0, 0] = pose[0, 1, 1] = yaw.cos()
        pose[0, 1, 0], pose[0, 0, 1] = yaw.sin(), -yaw.sin()
        pose[0, :2, 3] = torch.tensor([4000.0 + 3.0 * index, 1000.0 + 0.4 * index], dtype=torch.float64)
        yield FrameInputs(images, valid, pose, calibrate(rig, config))


def rows_of(instances: Instances) -> dict[str, np.ndarray]:
    valid = instances.valid[0]
    return {name: getattr(instances, name)[0][valid].numpy() for name in ("track_ids", "labels", "scores", "points")}


def assert_same_drive(checkpoint: Checkpoint, folder: Path, frames: int) -> int:
    """Compare both engines frame by frame; return the largest number of tracks that were there at once."""
    engines: tuple[Engine, Engine] = (
        TorchEngine(checkpoint.network, "cpu", Precision.FLOAT32, compiled=False),
        OnnxEngine(read_graph_folder(folder), threads=1),
    )
    states: list[Any] = [None, None]
    most = 0
    with torch.inference_mode():
        for inputs in drive(checkpoint.network.config, frames):
            (one, states[0], seen), (other, states[1], seen_too) = (
                engine.step(inputs, state) for engine, state in zip(engines, states, strict=True)
            )
            for mine, theirs in ((one.instances, other.instances), (one.detections, other.detections)):
                wanted, found = rows_of(mine), rows_of(theirs)
                np.testing.assert_array_equal(found["track_ids"], wanted["track_ids"])
                np.testing.assert_array_equal(found["labels"], wanted["labels"])
                np.testing.assert_allclose(found["points"], wanted["points"], atol=TOLERANCE)
                np.testing.assert_allclose(found["scores"], wanted["scores"], atol=TOLERANCE)
            np.testing.assert_allclose(seen_too.numpy(), seen.numpy(), atol=TOLERANCE)
            kept, padded = states[0].instances.valid[0], states[1].instances.valid[0]
            for name in ("history_maps", "forecasts", "point_history"):
                wanted, found = getattr(states[0], name)[0][kept], getattr(states[1], name)[0][padded]
                np.testing.assert_allclose(found.numpy(), wanted.numpy(), atol=TOLERANCE)
            most = max(most, int(kept.sum()))
    return most


@pytest.fixture(scope="module")
def lite_graphs(tmp_path_factory):
    checkpoint = networks_checkpoint(
        tiny_config("lite", decoder={"layers": 1}, tracking={"tau_d": 0.055, "tau_t": 0.05, "report_threshold": 0.02})
    )
    folder = tmp_path_factory.mktemp("graphs") / "lite"
    export_graphs(checkpoint, folder, rows=24)
    return checkpoint, folder


def test_a_drive_of_lite_is_the_same_in_onnx_runtime(lite_graphs):
    """Lost cameras, another car in the middle, tracks that end and come back; everything with state in and out."""
    checkpoint, folder = lite_graphs
    assert assert_same_drive(checkpoint, folder, frames=12) > 2


def test_what_the_folder_says_of_itself(lite_graphs, tmp_path):
    checkpoint, folder = lite_graphs
    about = read_graph_folder(folder)
    assert about.config == checkpoint.network.config
    assert (about.rows, about.sha256, about.facts) == (24, "0" * 64, {"seed": 0})
    with pytest.raises(UserError, match="exists already"):
        export_graphs(checkpoint, folder)
    with pytest.raises(UserError, match="no folder of exported graphs"):
        read_graph_folder(tmp_path)
    (tmp_path / ABOUT).write_text((folder / ABOUT).read_text().replace('"format": 1', '"format": 9'))
    with pytest.raises(UserError, match="format 9"):
        read_graph_folder(tmp_path)


def test_damaged_graphs_and_options_that_do_not_fit_are_refused(lite_graphs, tmp_path):
    _, folder = lite_graphs
    (tmp_path / ABOUT).write_text((folder / ABOUT).read_text())
    (tmp_path / "image_to_bev.onnx").write_bytes(b"\x08\x07 no graph")
    with pytest.raises(UserError, match="cannot be run"):
        OnnxEngine(read_graph_folder(tmp_path))
    with pytest.raises(UserError, match="float32 on the CPU"):
        OnnxEngine.open(NetworkOptions(weights=folder, precision=Precision.BFLOAT16))


def test_padded_rows_change_nothing():
    """The state that graphs begin with is the empty one."""
    checkpoint = networks_checkpoint(tiny_config("lite"))
    inputs = next(drive(checkpoint.network.config, 1))
    with torch.inference_mode():
        empty = checkpoint.network(inputs, checkpoint.network.initial_state(1)).layers[-1]
        padded = checkpoint.network(inputs, padded_state(checkpoint.network, 5)).layers[-1]
    torch.testing.assert_close(padded.points[:, 5:], empty.points)
    torch.testing.assert_close(padded.logits[:, 5:], empty.logits)


@pytest.mark.slow
def test_a_drive_of_the_papers_network_is_the_same_in_onnx_runtime(tmp_path):
    checkpoint = networks_checkpoint(small_config("paper-nuscenes"))
    export_graphs(checkpoint, tmp_path / "paper", rows=150)
    assert assert_same_drive(checkpoint, tmp_path / "paper", frames=6) > 2


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lite"])
def test_the_shipped_network_maps_a_whole_scene_the_same(tmp_path, name):
    """40 frames of a demo scene through the mapper; points in metres."""
    assert load_checkpoint().network.config.name == preset(name).name
    export_graphs(load_checkpoint(), tmp_path / name)
    mappers = Mapper.from_checkpoint(), Mapper.from_checkpoint(NetworkOptions(weights=tmp_path / name))
    scene = pmn.open_source()[0].open("scene-0103")
    states: list[StreamState | None] = [None, None]
    for index in range(len(scene)):
        maps = []
        for number, mapper in enumerate(mappers):
            frame_map, states[number] = mapper.step(scene.frame(index), states[number])
            maps.append(frame_map)
        np.testing.assert_array_equal(maps[0].track_ids, maps[1].track_ids)
        for one, other in zip(maps[0].polylines, maps[1].polylines, strict=True):
            np.testing.assert_allclose(one, other, atol=TOLERANCE)
        np.testing.assert_allclose(maps[0].scores, maps[1].scores, atol=TOLERANCE)
