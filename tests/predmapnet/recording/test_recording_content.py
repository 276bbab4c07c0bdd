"""Content of recordings: the whole map, labels, forecasts against what came, one track's memory, the place on Earth."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import rerun as rr
from rerun.chunk import RrdReader

from mapfusion.elements import ElementKind, FrameMap, GlobalMap, MapElement, RegionOfInterest
from mapfusion.formats.by_suffix import write_map
from mapfusion.formats.local_plane import LocalPlane
from predmapnet.datasets.nuscenes import NuScenesSource
from predmapnet.errors import UserError
from predmapnet.mapping import Step
from predmapnet.recording import RecordingFile, SceneRecorder, log_changes, log_maps
from predmapnet.recording.blueprint import TRUTH, Content, Extent, scene_blueprint
from predmapnet.recording.pictures import FRAME_BYTES, WIDEST, Pictures
from predmapnet.recording.tracks import TrackAges, forecast_errors_by_kind
from predmapnet.scenes import Camera
from tests.cli.tiny_nuscenes import write_tiny_nuscenes

ROI = RegionOfInterest()
LINE = np.array([[-20.0, 2.0], [20.0, 2.0]])
RING = np.array([[5.0, -4.0], [9.0, -4.0], [9.0, 4.0], [5.0, 4.0], [5.0, -4.0]])


def frame_map(timestamp, pose, ids, scores, forecast=LINE):
    kinds = [ElementKind.DIVIDER, ElementKind.PED_CROSSING, ElementKind.BOUNDARY][: len(ids)]
    lines = (LINE, RING, LINE - [0.0, 8.0])[: len(ids)]
    masks = np.stack([np.full((4, 8), 0.1 * (row + 1), dtype=np.float32) for row in range(len(ids))])
    forecasts = (forecast, RING, np.zeros((0, 2)))[: len(ids)]
    seen = np.zeros((3, 4, 8), dtype=np.float32)
    return FrameMap(timestamp, pose, ROI, kinds, scores, ids, lines, forecasts, seen, masks)


@pytest.fixture(scope="module")
def chunks(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recording")
    scene = NuScenesSource(write_tiny_nuscenes(folder / "data")).open("scene-0001")
    recording = rr.RecordingStream("predmapnet", recording_id="test")
    element = MapElement(
        ElementKind.DIVIDER, LINE, 0.5, 8, 10**18, 10**18 + 1, (7,), np.full(2, 0.25), name="divider-1", paint="dashed"
    )
    with RecordingFile(recording, folder / "r.rrd"):
        recorder = SceneRecorder(recording, "# Text", place=scene.georeference)
        recorder.begin(scene, ROI)
        for index in range(3):
            frame = scene.frame(index)
            ids, scores = ([7, 8, 9], [0.7, 0.9, 0.5]) if index < 2 else ([7, 9], [0.7, 0.5])
            found = frame_map(frame.timestamp, frame.ego_to_global, ids, scores, forecast=LINE + np.array([0.0, 0.5]))
            timings = dict.fromkeys(("images", "network", "integration"), 1.0)
            recorder.observe(Step(frame, found, timings, True), lambda: GlobalMap((element,)))
        recorder.end(GlobalMap((element,)))
    entities: dict[str, list] = {}
    for chunk in RrdReader(folder / "r.rrd").stream():
        entities.setdefault(chunk.entity_path, []).append(chunk)
    return entities


def values(chunks, entity, component):
    """Return the values of a component, one entry a row, in the order of time."""
    found = []
    for chunk in chunks[entity]:
        batch = chunk.to_record_batch()
        if component in batch.schema.names:
            times = batch.column("frame").to_pylist() if "frame" in batch.schema.names else [0] * batch.num_rows
            found += zip(times, batch.column(component).to_pylist(), strict=True)
    return [value for _, value in sorted(found, key=lambda row: row[0])]


def test_a_track_says_its_kind_id_score_and_age(chunks):
    entity = "/world/ego_vehicle/tracks/divider"
    labels = values(chunks, entity, "LineStrips3D:labels")
    assert labels[0] == ["divider 7, score 0.70, 0.0 s old"]
    assert labels[2][0].endswith("1.0 s old")
    pictures = values(chunks, "/world/ego_vehicle/CAM_FRONT/tracks", "LineStrips2D:labels")
    assert any("crossing 8, score 0.90" in label for label in pictures[0])


def test_the_whole_map_is_there_at_every_frame_and_says_what_it_is(chunks):
    (chunk,) = chunks["/world/whole_map/divider"]
    assert chunk.is_static
    (labels,) = values(chunks, "/world/whole_map/divider", "LineStrips3D:labels")
    assert labels == ["dashed divider divider-1, confidence 0.50, 8 observations, 40 m, deviation 0.25 m"]
    (strip,) = values(chunks, "/world/way", "LineStrips3D:strips")
    np.testing.assert_allclose(strip[0][0][:2], [0.0, 0.0])
    np.testing.assert_allclose(np.linalg.norm(strip[0][-1]), 8.0, atol=1e-4)
    assert "/world/map/divider/divider-1" in chunks


SHOWN_AT_THE_POINTER = 3
"""The viewer shows the values of at most so many components that differ between lines, and else their number."""


@pytest.mark.parametrize("entity", ["/world/whole_map/divider", "/world/ego_vehicle/tracks/divider"])
def test_the_viewer_tells_at_the_pointer_what_a_line_is(chunks, entity):
    found = {name for chunk in chunks[entity] for name in chunk.to_record_batch().schema.names}
    alike = {"LineStrips3D:show_labels", "LineStrips3D:radii"}
    told = {name for name in found - alike if not name.startswith(("frame", "time", "log", "rerun"))}
    assert {"LineStrips3D:strips", "LineStrips3D:labels"} <= told
    assert len(told) <= SHOWN_AT_THE_POINTER, told


def test_forecasts_are_held_against_what_came(chunks):
    errors = values(chunks, "/plots/forecast_error/divider", "Scalars:scalars")
    np.testing.assert_allclose(np.ravel(errors), [0.5, 0.5])
    assert len(values(chunks, "/bev/forecast", "LineStrips2D:strips")) == 2


def test_one_tracks_memory_is_shown_until_it_is_gone(chunks):
    labels = [row[0] for row in values(chunks, "/bev/picked_track/line", "LineStrips2D:labels")]
    assert [label.split(",")[0] for label in labels] == ["crossing 8", "crossing 8", "divider 7"]


def test_the_map_lies_where_it_is_on_earth(chunks):
    """Latitude comes first: Singapore lies at 1.3 degrees north and 103.8 degrees east."""
    (name,) = [entity for entity in chunks if entity.startswith("/earth/map/divider/")]
    for entity, component in ((name, "GeoLineStrings:line_strings"), ("/earth/car", "GeoPoints:positions")):
        place = np.reshape(values(chunks, entity, component)[0], (-1, 2))[0]
        assert 1.0 < place[0] < 1.6
        assert 103.0 < place[1] < 104.5


def test_a_wanted_track_is_shown_and_nothing_while_it_is_not_there():
    ages = TrackAges()
    first = ages.tracks_of(frame_map(0, np.eye(4), [3], [0.5]))
    later = ages.tracks_of(frame_map(2_500_000_000, np.eye(4), [3, 4], [0.5, 0.6]))
    assert first.ages == (0.0,)
    assert later.ages == (2.5, 0.0)
    assert later.select(later.frame_map.track_ids == 4).labels == ["crossing 4, score 0.60, 0.0 s old"]


def test_a_forecast_of_a_track_that_ended_counts_for_nothing():
    before = frame_map(0, np.eye(4), [1, 2], [0.9, 0.9], forecast=LINE + np.array([0.0, 0.3]))
    assert forecast_errors_by_kind(before, frame_map(1, np.eye(4), [1], [0.9])) == {
        ElementKind.DIVIDER: pytest.approx(0.3)
    }
    assert forecast_errors_by_kind(before, frame_map(1, np.eye(4), [5], [0.9])) == {}


def views(part):
    inner = getattr(part, "contents", None)
    if isinstance(inner, list | tuple) and not isinstance(inner, str) and inner and not isinstance(inner[0], str):
        return [view for one in inner for view in views(one)]
    return [part]


def test_the_layout_shows_what_there_is(tmp_path):
    rig = NuScenesSource(write_tiny_nuscenes(tmp_path)).open("scene-0001").rig
    extent = Extent.of(np.array([[0.0, 0.0], [400.0, 100.0]]), 30.0)

    def names(**what):
        content = Content(extent, **what)
        return {str(view.name): view for view in views(scene_blueprint(rig, (200, 400), content).root_container)}

    full = names(truth=True, on_earth=True)
    assert {"CAM_FRONT", "Around the car", "The whole map", "With ground truth (grey)", "On Earth"} <= set(full)
    assert TRUTH in full["The whole map"].visualizer_overrides
    assert TRUTH not in full["With ground truth (grey)"].visualizer_overrides
    bare = names(truth=False, on_earth=False, forecasts=False, memory=False)
    assert not {"With ground truth (grey)", "On Earth", "What one track remembers", "Forecast error, m"} & set(bare)
    assert extent.centre == (200.0, 50.0)
    assert (extent.width, extent.height) == (460.0, 160.0)


def test_pictures_of_a_frame_fit_into_their_share_and_lines_still_lie_on_them(tmp_path):
    rng = np.random.default_rng(0)
    noise = cv2.resize(rng.integers(0, 255, (60, 107, 3), dtype=np.uint8), (1600, 900))
    cv2.imwrite(str(tmp_path / "large.jpg"), noise, [cv2.IMWRITE_JPEG_QUALITY, 95])
    small = np.full((90, 160, 3), 127, dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "small.jpg"), small)
    intrinsics = np.array([[1000.0, 0.0, 800.0], [0.0, 1000.0, 450.0], [0.0, 0.0, 1.0]])
    rig = tuple(Camera(f"C{number}", 1600, 900, intrinsics, np.eye(4)) for number in range(6))
    rig += (Camera("SMALL", 160, 90, intrinsics, np.eye(4)),)
    pictures = Pictures(rig)
    assert (pictures.rig[0].width, pictures.rig[0].height) == (WIDEST, 450)
    np.testing.assert_allclose(pictures.rig[0].intrinsics[:2], intrinsics[:2] / 2)
    content = pictures.encoded("C0", tmp_path / "large.jpg").blob.as_arrow_array().to_pylist()[0]
    assert len(content) <= FRAME_BYTES / len(rig)
    shown = cv2.imdecode(np.array(content, dtype=np.uint8), cv2.IMREAD_COLOR)
    assert shown.shape == (450, WIDEST, 3)
    assert np.abs(shown.mean(axis=(0, 1)) - noise.mean(axis=(0, 1))).max() < 3, "colours are not swapped"
    kept = pictures.encoded("SMALL", tmp_path / "small.jpg").blob.as_arrow_array().to_pylist()[0]
    assert bytes(kept) == (tmp_path / "small.jpg").read_bytes()


def drawn(log, paths, file: Path):
    recording = rr.RecordingStream("predmapnet", recording_id=file.stem)
    with RecordingFile(recording, file):
        log(recording, paths)
    return {chunk.entity_path for chunk in RrdReader(file).stream()}


PLANE = LocalPlane(8.4, 49.0)


def street(path, shift=0.0, **provenance):
    lines = [np.array([[0.0, 0.0], [90.0, 0.0], [90.0, 60.0]]), np.array([[0.0, 4.0], [80.0, 4.0 + shift]])]
    kinds = [ElementKind.BOUNDARY, ElementKind.DIVIDER]
    elements = (MapElement(kind, line, 0.9, 8, 10**18, 10**18 + 1) for kind, line in zip(kinds, lines, strict=True))
    write_map(GlobalMap(tuple(elements)), path, PLANE, provenance)
    return path


def test_maps_of_any_format_are_seen_together(tmp_path):
    paths = [street(tmp_path / f"{number}.{ending}") for number, ending in enumerate(("geojson", "gpkg", "fgb", "osm"))]
    entities = drawn(log_maps, paths, tmp_path / "maps.rrd")
    assert {f"/world/maps/{number}/divider" for number in range(4)} <= entities
    assert any(entity.startswith("/earth/maps/0/boundary") for entity in entities)
    made_up = street(tmp_path / "town.geojson", synthetic=True)
    assert not any(entity.startswith("/earth") for entity in drawn(log_maps, [made_up], tmp_path / "one.rrd"))


def test_two_maps_show_what_changed(tmp_path):
    paths = [street(tmp_path / "old.geojson"), street(tmp_path / "new.geojson", shift=6.0)]
    entities = drawn(log_changes, paths, tmp_path / "diff.rrd")
    assert {"/world/removed/divider", "/world/added/divider", "/world/unchanged/boundary"} <= entities


def test_nothing_to_see_is_an_error(tmp_path):
    write_map(GlobalMap(()), tmp_path / "empty.geojson", PLANE)
    with pytest.raises(UserError, match=r"empty\.geojson"):
        drawn(log_maps, [tmp_path / "empty.geojson"], tmp_path / "x.rrd")
