"""Other detectors' results become a map, and what does not fit is named."""

import json
from dataclasses import replace

import numpy as np
import pytest

from mapfusion import ElementKind
from mapfusion.formats.by_suffix import read_map
from mapfusion.formats.local_plane import LocalPlane
from mapfusion.ground import coverage
from predmapnet.frame_files.parquet import StoredFrame, write_frames
from tests.mapfusion.map_quality import measure
from tests.mapfusion.pose_noise import off_by_frame
from tests.mapfusion.simulation import town_drive

ORIGIN = "49.0,8.4"
PLANE = LocalPlane(8.4, 49.0)
NAMES = ("ped_crossing", "divider", "boundary")


@pytest.fixture(scope="module")
def drive():
    return town_drive(3, frames=12)


def submission(drive, ids=True) -> dict:
    results = {}
    for number, frame in enumerate(drive.frames):
        entry = {
            "vectors": [line.tolist() for line in frame.polylines],
            "scores": frame.scores.tolist(),
            "labels": frame.kinds.tolist(),
        }
        results[f"token-{number}"] = entry | ({"global_ids": frame.track_ids.tolist()} if ids else {})
    return {"meta": {}, "results": results}


def maptr(drive) -> dict:
    """As MapTR writes on nuScenes: x right, y forward, classes by name, crossings not closed."""
    results = []
    for number, frame in enumerate(drive.frames):
        vectors = [
            {
                "pts": np.column_stack([-line[:, 1], line[:, 0]]).tolist(),
                "cls_name": NAMES[kind],
                "type": 0,
                "confidence_level": score,
            }
            for line, kind, score in zip(frame.polylines, frame.kinds, frame.scores, strict=True)
        ]
        results.append({"sample_token": f"token-{number}", "vectors": vectors})
    return {"meta": {}, "results": results}


def poses(drive) -> dict:
    return {
        f"token-{i}": {"timestamp": f.timestamp, "ego_to_global": f.ego_to_global.tolist(), "scene": "log-1"}
        for i, f in enumerate(drive.frames)
    }


def write(path, content):
    path.write_text(json.dumps(content))
    return path


@pytest.fixture
def reference(predmapnet, tmp_path, drive):
    """The map of the same frames from our own Parquet, which the others must equal."""
    stored = [StoredFrame("log-1", i, "", frame) for i, frame in enumerate(drive.frames)]
    write_frames(tmp_path / "frames.parquet", stored, {"location": "somewhere"})
    result = predmapnet("integrate", "frames.parquet", "--origin", ORIGIN, "--out", "reference.geojson")
    assert result.code == 0, result.err
    found = read_map(tmp_path / "reference.geojson", PLANE)
    assert len(found) > 5
    return found


def assert_like(one, two, share):
    for kind in (ElementKind.DIVIDER, ElementKind.BOUNDARY):
        assert one.length(kind) == pytest.approx(two.length(kind), rel=share)


def test_a_submission_with_ids_gives_the_same_map(predmapnet, tmp_path, drive, reference):
    write(tmp_path / "results.json", submission(drive))
    write(tmp_path / "poses.json", poses(drive))
    result = predmapnet("integrate", "results.json", "--poses", "poses.json", "--origin", ORIGIN, "--out", "map.gpkg")
    assert result.code == 0, result.err
    assert "12 frames of 1 drive" in result.out
    assert_like(read_map(tmp_path / "map.gpkg", PLANE), reference, 1e-4)


def test_results_of_maptr_and_poses_in_csv(predmapnet, tmp_path, drive, reference):
    write(tmp_path / "results.json", maptr(drive))
    lines = ["token,timestamp,x,y,yaw,scene"]
    for i, frame in enumerate(drive.frames):
        pose = frame.ego_to_global
        x, y, yaw = pose[0, 3], pose[1, 3], np.arctan2(pose[1, 0], pose[0, 0])
        lines.append(
            f"token-{i},{frame.timestamp},{x!r},{y!r},{yaw!r},log-1".replace("np.float64(", "").replace(")", "")
        )
    (tmp_path / "poses.csv").write_text("\n".join(lines))
    arguments = ("integrate", "results.json", "--poses", "poses.csv", "--origin", ORIGIN, "--out", "map.geojson")
    turned = predmapnet(*arguments)
    assert turned.code == 2
    assert "--y-forward" in turned.err
    result = predmapnet(*arguments, "--y-forward")
    assert result.code == 0, result.err
    assert "no track ids" in result.err
    assert_like(read_map(tmp_path / "map.geojson", PLANE), reference, 0.25)


def change(found, path, value):
    for key in path[:-1]:
        found = found[key]
    found[path[-1]] = value


@pytest.mark.parametrize(
    ("in_poses", "path", "value", "words"),
    [
        (True, ("token-3", "ego_to_global", 0, 3), float("inf"), "pose"),
        (True, ("token-3", "ego_to_global", 0, 0), 7.0, "not rigid"),
        (True, ("token-3", "ego_to_global"), [1, 2], "2 numbers instead of 16"),
        (True, ("token-3", "timestamp"), "noon", "token-3"),
        (False, ("results", "token-3", "scores"), [0.5], "token-3"),
        (False, ("results", "token-3"), 5, "token-3"),
    ],
)
def test_mistakes_are_named(predmapnet, tmp_path, drive, in_poses, path, value, words):
    results, where = submission(drive), poses(drive)
    change(where if in_poses else results, path, value)
    write(tmp_path / "results.json", results)
    write(tmp_path / "poses.json", where)
    result = predmapnet("integrate", "results.json", "--poses", "poses.json", "--origin", ORIGIN, "-o", "map.geojson")
    assert result.code == 2
    assert words in result.err
    assert "Traceback" not in result.err
    assert not (tmp_path / "map.geojson").exists()


def test_tokens_that_do_not_match_are_named(predmapnet, tmp_path, drive):
    write(tmp_path / "results.json", submission(drive))
    write(tmp_path / "poses.json", {f"sample-{key}": pose for key, pose in poses(drive).items()})
    result = predmapnet("integrate", "results.json", "--poses", "poses.json", "--origin", ORIGIN, "-o", "map.geojson")
    assert result.code == 2
    assert "12 of 12 frames" in result.err
    assert "sample-token-0" in result.err
    for arguments, words in (
        (("results.json", "-o", "map.geojson", "--origin", ORIGIN), "--poses"),
        (("results.json", "--poses", "poses.json", "-o", "map.geojson", "--location", "Atlantis"), "boston-seaport"),
        (("results.json", "--poses", "poses.json", "-o", "map.geojson", "--origin", "here"), "latitude,longitude"),
        (("results.json", "--poses", "poses.json", "-o", "map.geojson", "--roi", "big"), "60x30"),
        (("nothing.json", "--poses", "poses.json", "-o", "map.geojson"), "no file"),
    ):
        result = predmapnet("integrate", *arguments)
        assert result.code == 2, arguments
        assert words in result.err


def test_points_that_are_not_finite_are_counted(predmapnet, tmp_path, drive):
    results = submission(drive)
    results["results"]["token-2"]["vectors"][0][1][0] = float("nan")
    write(tmp_path / "results.json", results)
    write(tmp_path / "poses.json", poses(drive))
    result = predmapnet("integrate", "results.json", "--poses", "poses.json", "--origin", ORIGIN, "-o", "map.geojson")
    assert result.code == 0, result.err
    assert "1 x points not finite" in result.err


def test_frames_of_a_demo_town_know_their_place_and_what_was_observed(predmapnet, tmp_path, drive):
    told = {"location": "town-0007", "synthetic": True}
    stored = [StoredFrame("scene-0007", i, "", frame) for i, frame in enumerate(drive.frames)]
    write_frames(tmp_path / "frames.parquet", stored, told)
    result = predmapnet("integrate", "frames.parquet", "--out", "map.geojson")
    assert result.code == 0, result.err
    found = json.loads((tmp_path / "map.geojson").read_text())
    longitude, latitude = np.array(found["features"][0]["geometry"]["coordinates"]).reshape(-1, 2)[0]
    assert (longitude, latitude) == pytest.approx((-123.39 + 0.7, -48.88), abs=0.1)
    plane = LocalPlane(float(longitude), float(latitude))
    half = predmapnet("integrate", "frames.parquet", "--origin", ORIGIN, "--out", "there.gpkg")
    assert half.code == 0, half.err
    spoken = coverage(read_map(tmp_path / "map.geojson", plane), plane)
    elsewhere = coverage(read_map(tmp_path / "there.gpkg", PLANE), PLANE)
    assert spoken.area == pytest.approx(elsewhere.area, rel=0.02)
    assert spoken.area == pytest.approx(12 * 4.5 * 26.0 + 56.0 * 26.0 - 4.5 * 26.0, rel=0.1)
    write_frames(tmp_path / "frames.parquet", stored[:1], told | {"location": "boston-seaport"})
    lost = predmapnet("integrate", "frames.parquet", "--out", "map.geojson")
    assert lost.code == 2
    assert "--origin" in lost.err


def test_ground_that_could_not_be_seen_is_told_by_a_submission(predmapnet, tmp_path):
    """A line of five frames, then thirty without it: gone, unless the frames say that it was hidden."""
    line = {"vectors": [[[5, 6], [25, 6]]], "scores": [0.6], "labels": [1], "global_ids": [0]}
    nothing = {"vectors": [], "scores": [], "labels": [], "global_ids": []}
    right = [[[-30, -15], [30, -15], [30, 2], [-30, 2]]]
    pose = {"scene": "log-1", "ego_to_global": np.eye(4).tolist()}
    write(tmp_path / "poses.json", {f"t{i}": pose | {"timestamp": i * 500_000_000} for i in range(35)})
    for visible, expected in (({}, 0), ({"visible": right}, 1)):
        results = {f"t{i}": line if i < 5 else nothing | visible for i in range(35)}
        write(tmp_path / "results.json", {"meta": {}, "results": results})
        arguments = ("results.json", "--poses", "poses.json", "--origin", ORIGIN, "--out", "map.geojson")
        assert predmapnet("integrate", *arguments).code == 0
        assert len(read_map(tmp_path / "map.geojson", PLANE)) == expected
    write(tmp_path / "results.json", {"meta": {}, "results": {"t0": line | {"visible": 3}}})
    assert "visible" in predmapnet("integrate", *arguments).err


def test_poses_of_single_frames_are_corrected_if_wanted(predmapnet, tmp_path, drive):
    poses_off = off_by_frame([frame.ego_to_global for frame in drive.frames], np.random.default_rng(0))
    stored = [
        StoredFrame("log-1", i, "", replace(frame, ego_to_global=at))
        for i, (frame, at) in enumerate(zip(drive.frames, poses_off, strict=True))
    ]
    write_frames(tmp_path / "frames.parquet", stored, {"location": "somewhere"})
    quality = {}
    for option in ((), ("--correct-poses",)):
        arguments = ("integrate", "frames.parquet", "--origin", ORIGIN, "--out", "map.geojson", *option)
        result = predmapnet(*arguments)
        assert result.code == 0, result.err
        assert ("poses of log-1 corrected by" in result.err) is bool(option)
        quality[bool(option)] = measure(read_map(tmp_path / "map.geojson", PLANE), drive, within=0.3)
    assert quality[True].precision > quality[False].precision + 0.03, quality
    assert quality[True].recall > quality[False].recall
