"""The weights that come with the package see, and seeing in a stream is worth its while. Validation towns only."""

from dataclasses import dataclass

import pytest

from mapfusion.integrate.integrator import MapIntegrator
from predmapnet.config import PredMapNetConfig
from predmapnet.datasets.ground_truth.whole_map import truth_map
from predmapnet.demo_world.catalogue import trajectory, vector_map
from predmapnet.demo_world.rig import LIDAR_TO_EGO
from predmapnet.demo_world.truth import truth_from_vector_map
from predmapnet.evaluation.global_map import THRESHOLDS, global_map_quality, seen_area
from predmapnet.frame_cache.fill_cache import cache_demo_scene
from predmapnet.frame_cache.scene_cache import CachedScene
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.training.validation import map_frames, validate
from predmapnet.weights.checkpoint import load_checkpoint
from predmapnet.weights.files import SHIPPED

MEGABYTE = 1e6


@dataclass
class Rendered:
    network: PredMapNet
    scene: CachedScene


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Rendered:
    network = load_checkpoint().network
    folder = tmp_path_factory.mktemp("towns") / "scene-0002"
    cache_demo_scene(folder, network.config)
    return Rendered(network, CachedScene(folder))


def mean_ap(rendered: Rendered, *, streaming: bool, **tracking: object) -> float:
    config: PredMapNetConfig = rendered.network.config
    changed = config.tracking.model_copy(update=tracking)
    rendered.network.config = config.model_copy(update={"tracking": changed})
    try:
        return validate(rendered.network, [rendered.scene], streaming)["mAP"]
    finally:
        rendered.network.config = config


def test_the_file_is_small():
    assert SHIPPED.stat().st_size < 20 * MEGABYTE


def test_streaming_is_at_least_as_good_as_single_frames(rendered: Rendered):
    streaming, single = mean_ap(rendered, streaming=True), mean_ap(rendered, streaming=False)
    assert streaming >= single
    assert streaming >= 0.551  # It is 0.5558.
    assert single >= 0.477  # It is 0.4818.


def test_without_merging_tracks_and_detections_repeat_each_other(rendered: Rendered):
    assert mean_ap(rendered, streaming=True, merge=False) < 0.551 - 0.1


def test_the_map_of_a_drive_is_found_and_right(rendered: Rendered):
    scene, roi = rendered.scene, rendered.network.config.roi
    drive = trajectory(scene.name)
    integrator = MapIntegrator()
    for frame_map in map_frames(rendered.network, scene, range(len(scene)), streaming=True):
        integrator.add(frame_map)
    poses = drive.ego_to_global @ LIDAR_TO_EGO
    truth = truth_map(
        truth_from_vector_map(vector_map(scene.name)), list(zip(drive.timestamps.tolist(), poses, strict=True)), roi
    )
    quality = global_map_quality(
        integrator.map(), truth, seen_area([scene.frame(i, images=False).ego_to_global for i in range(len(scene))], roi)
    ).overall
    at_one_metre = THRESHOLDS.index(1.0)
    assert quality.precision[at_one_metre] >= 0.800  # It is 0.812.
    assert quality.recall[at_one_metre] >= 0.754  # It is 0.766.
