"""Observed ground of a map where a camera has no image: by command, by function and in a script."""

import numpy as np
import pytest
import shapely
from rerun.chunk import RrdReader

from mapfusion.elements import RegionOfInterest
from mapfusion.formats.by_suffix import read_map
from mapfusion.formats.local_plane import LocalPlane
from mapfusion.ground import ground_within
from mapfusion.integrate.integrator import MapIntegrator
from predmapnet.datasets.nuscenes import NuScenesSource
from predmapnet.machine import NetworkOptions
from predmapnet.mapper import Mapper
from predmapnet.mapping import NETWORK_ERRORS, map_scene
from tests.cli.tiny_nuscenes import image_path, write_tiny_nuscenes


def without_camera(folder, camera, scene="scene-0001", frames=3):
    root = write_tiny_nuscenes(folder, (scene,), frames=frames)
    for index in range(frames):
        image_path(root, scene, index, camera).unlink()
    return root


def observed_area(path):
    rings = [np.array(ring) for ring in read_map(path).provenance["observed"]]
    plane = LocalPlane(*np.concatenate(rings).mean(axis=0))
    return ground_within([plane.from_wgs84(ring) for ring in rings]).area


@pytest.mark.parametrize("command", ["infer", "integrate"])
def test_a_map_claims_no_ground_that_only_a_missing_camera_would_have_seen(
    predmapnet, random_weights, tmp_path, command
):
    roi = RegionOfInterest()
    area = {}
    for name, root in {
        "all": write_tiny_nuscenes(tmp_path / "whole", ("scene-0001",), frames=1),
        "without": without_camera(tmp_path / "gap", "CAM_BACK", frames=1),
    }.items():
        options = ("--data-root", root, "--weights", random_weights, "--threads", 1, "--allow-missing-cameras")
        result = predmapnet("infer", "scene-0001", "--out", "map.geojson", "--save-frames", "f.parquet", *options)
        assert result.code == 0, result.err
        if command == "integrate":
            assert predmapnet("integrate", "f.parquet", "--out", "map.geojson").code == 0
        area[name] = observed_area(tmp_path / "map.geojson")
    assert area["all"] == pytest.approx(roi.length * roi.width, rel=0.01)
    assert 0.5 * area["all"] < area["without"] < 0.8 * area["all"]


def test_missing_images_are_said_and_written_into_every_file(predmapnet, random_weights, tmp_path):
    root = without_camera(tmp_path / "gap", "CAM_BACK", frames=2)
    options = ("--data-root", root, "--weights", random_weights, "--threads", 1, "--allow-missing-cameras")
    files = ("--out", "map.geojson", "--save-frames", "f.parquet", "--recording", "r.rrd")
    result = predmapnet("infer", "scene-0001", *files, *options)
    assert "CAM_BACK in 2 of 2 frames" in " ".join(result.err.split())
    provenance = read_map(tmp_path / "map.geojson").provenance
    assert provenance["missing_images"] == {"CAM_BACK": 2}
    assert "CAM_BACK in 2 of 2 frames" in provenance["note"]
    assert predmapnet("integrate", "f.parquet", "--out", "again.geojson").code == 0
    assert read_map(tmp_path / "again.geojson").provenance["missing_images"] == {"CAM_BACK": 2}
    chunks = [chunk for chunk in RrdReader(tmp_path / "r.rrd").stream() if chunk.entity_path == "/description"]
    assert any(
        "CAM_BACK in 2 of 2 frames" in str(chunk.to_record_batch().column("TextDocument:text")) for chunk in chunks
    )


def test_a_script_that_loops_over_frames_gets_the_map_of_the_command(predmapnet, random_weights, tmp_path):
    root = without_camera(tmp_path / "data", "CAM_BACK", frames=4)
    arguments = ("--data-root", root, "--weights", random_weights, "--threads", 1, "--allow-missing-cameras")
    assert predmapnet("infer", "scene-0001", "--out", "map.geojson", *arguments).code == 0

    scene = NuScenesSource(root).open("scene-0001")
    mapper = Mapper.from_checkpoint(NetworkOptions(random_weights))
    integrator, state = MapIntegrator(NETWORK_ERRORS), None
    for index in range(len(scene)):
        frame_map, state = mapper.step(scene.frame(index), state, allow_missing_cameras=True)
        integrator.add(frame_map, log="scene-0001")
    looped = integrator.map()
    run = map_scene(scene, mapper, allow_missing_cameras=True)

    written = read_map(tmp_path / "map.geojson")
    assert len(looped) == len(run.global_map) == len(written) > 0
    for one, other, stored in zip(looped, run.global_map, written, strict=True):
        assert one.kind is other.kind is stored.kind
        np.testing.assert_array_equal(one.points, other.points)
        assert one.confidence == other.confidence == pytest.approx(stored.confidence, abs=1e-4)
        assert (one.observations, one.track_ids) == (other.observations, other.track_ids)
        assert one.length == pytest.approx(stored.length, rel=0.01)
    assert shapely.area(run.observed) < 1500 + 4 * 4 * 30
