"""Several drives' maps of one place become one: poses corrected, evidence added, whatever the order and the tiles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import shapely

from mapfusion import ElementKind, GlobalMap, MapElement, MapIntegrator
from mapfusion.alignment import align, landmarks, move
from mapfusion.formats.by_suffix import read_map, write_map
from mapfusion.formats.local_plane import LocalPlane
from mapfusion.geometry import arc_length
from mapfusion.ground import RIM, coverage, ground_within, near_elements, observed_rings
from mapfusion.merge.config import MergeConfig
from mapfusion.merge.contribution import Looks, certainty
from mapfusion.merge.merge import merge_files, merge_maps
from mapfusion.merge.report import short_names
from predmapnet.runs.process_executor import ProcessExecutor
from tests.mapfusion.integrate.test_integrator_properties import frame_map
from tests.mapfusion.map_quality import measure
from tests.mapfusion.simulation import simulate, town_road

DIVIDER, BOUNDARY, CROSSING = ElementKind.DIVIDER, ElementKind.BOUNDARY, ElementKind.PED_CROSSING


def town(seed: int = 3) -> GlobalMap:
    truth = town_road(np.random.default_rng(seed))[0]
    centre = np.concatenate([e.points for e in truth]).mean(axis=0)
    return GlobalMap(tuple(replace(e, points=e.points - centre) for e in truth))


def line(points, kind=DIVIDER, **more) -> MapElement:
    return MapElement(
        kind,
        np.array(points, dtype=float),
        **{"confidence": 0.9, "observations": 9, "first_seen": 5, "last_seen": 9, **more},
    )


def drive_map(truth: GlobalMap, rng, noise=0.15, offset=(0.0, 0.0), turn=0.0, drop=0.1) -> GlobalMap:
    """What one drive might have made of the truth: each element displaced and bent, some missed, all offset."""
    elements = []
    for element in truth:
        if rng.random() < drop:
            continue
        points = shapely.get_coordinates(shapely.segmentize(shapely.LineString(element.points), 2.0))
        if not element.kind.is_ring and len(points) > 20:  # cut anywhere, run either way
            start, stop = sorted(rng.integers(0, len(points), 2).tolist())
            pieces = [points[: start + 1], points[start : stop + 1], points[stop:]]
        else:
            pieces = [points]
        for piece in pieces:
            if arc_length(piece)[-1] < 3.0:
                continue
            wave = np.sin(arc_length(piece) / 25.0 + rng.uniform(0, 6))[:, None] * rng.normal(0, noise / 1.4, 2)
            moved = piece + wave + rng.normal(0, noise / 1.4, 2)
            if element.kind.is_ring:
                moved[-1] = moved[0]
            moved = move(moved, np.zeros(2), np.array(offset), turn)
            elements.append(line(moved[:: 1 if rng.random() < 0.5 or element.kind.is_ring else -1], element.kind))
    return GlobalMap(tuple(elements))


def samples(elements, spacing=1.0):
    if not elements:
        return np.empty((0, 2))
    return np.concatenate(
        [shapely.get_coordinates(shapely.segmentize(shapely.LineString(e.points), spacing)) for e in elements]
    )


def far_from(elements, truth, distance) -> float:
    """Share of one set of lines that lies farther than a distance from another."""
    union = shapely.union_all([shapely.LineString(e.points) for e in truth])
    return float((shapely.distance(shapely.points(samples(elements)), union) > distance).mean())


@pytest.mark.parametrize("seed", range(4))
def test_alignment_finds_the_offset_between_noisy_maps(seed):
    """Two drives with poses off by 0.75 m, 1.5 m and 0.85 degrees (RTMap's) are seldom farther apart."""
    rng = np.random.default_rng(seed)
    truth = town(seed)
    offset, turn = rng.uniform(-4.5, 4.5, 2), np.radians(rng.uniform(-3.2, 3.2))
    one = landmarks(drive_map(truth, rng))
    two = landmarks(drive_map(truth, rng, offset=offset, turn=turn))
    found = align(two, one)
    assert found.certain, found.refusal
    spots = samples(truth.elements)
    left = found.apply(move(spots, np.zeros(2), offset, turn)) - spots
    assert np.abs(left).max() < 0.35
    assert np.median(np.linalg.norm(left, axis=1)) < 0.15


def test_alignment_is_refused_where_it_cannot_be_certain():
    x = np.linspace(0, 200, 201)
    road = GlobalMap(tuple(line(np.stack([x, np.full(201, y)], axis=1), BOUNDARY) for y in (-7.3, 6.1)))
    shifted = GlobalMap(tuple(replace(e, points=e.points + np.array([3.0, 0.4])) for e in road))
    assert "parallel" in align(landmarks(shifted), landmarks(road)).refusal
    far = GlobalMap(tuple(replace(e, points=e.points + 900.0) for e in road))
    assert "only 0 m" in align(landmarks(far), landmarks(road)).refusal
    rng = np.random.default_rng(0)
    other = GlobalMap(
        tuple(line(np.stack([x, 3 * np.sin(x / 9 + rng.uniform(0, 6)) + y], axis=1), BOUNDARY) for y in (-7, 0, 7))
    )
    found = align(landmarks(other), landmarks(road))
    assert not found.certain
    assert found.disagrees


def test_merging_drives_takes_out_their_offsets_and_half_their_noise():
    rng = np.random.default_rng(5)
    truth = town()
    maps = [drive_map(truth, rng, offset=rng.normal(0, 1.0, 2), turn=np.radians(rng.normal(0, 0.2))) for _ in range(8)]
    merged, report = merge_maps(maps)
    assert all(status.partners >= 2 and not status.note for status in report.maps)
    # the whole may lie off by the mean of the drives' offsets: compare after that is taken out
    centred = align(landmarks(merged), landmarks(truth))
    merged = GlobalMap(tuple(replace(e, points=centred.apply(e.points)) for e in merged))
    for kind in ElementKind:
        own, true = merged.of_kind(kind), truth.of_kind(kind)
        assert far_from(own, true, 0.5) < 0.02, kind
        assert far_from(true, own, 0.5) < 0.03, kind
        assert len(own) <= 1.3 * len(true)
        length = sum(e.length for e in own) / sum(e.length for e in true)
        assert 0.95 < length < 1.05, (kind, length)
    union = shapely.union_all([shapely.LineString(e.points) for e in truth.of_kind(DIVIDER)])
    errors = shapely.distance(shapely.points(samples(merged.of_kind(DIVIDER))), union)
    assert np.median(errors) < 0.08
    assert all(1 < len(e.sources) <= 8 for e in merged)


def test_a_map_that_contradicts_the_others_is_kept_as_it_is_and_said():
    x = np.linspace(0, 200, 201)
    corner = line([[0, 40], [60, 40], [60, 90]], BOUNDARY)
    road = GlobalMap((*(line(np.stack([x, np.full(201, y)], axis=1), BOUNDARY) for y in (-7.3, 6.1)), corner))
    again = GlobalMap(tuple(replace(e, points=e.points + 0.2) for e in road))
    waves = (3 * np.sin(x / 9 + phase) + y for phase, y in ((1.0, -7.0), (4.0, 0.0), (2.0, 7.0)))
    other = GlobalMap(tuple(line(np.stack([x, wave], axis=1), BOUNDARY) for wave in waves))
    merged, report = merge_maps([road, again, other], ["road", "again", "other"])
    assert [status.name for status in report.maps if status.apart] == ["other"]
    kept = [element for element in merged if element.sources == ("other",)]
    assert [e.points.tobytes() for e in kept] == [e.points.tobytes() for e in other]
    assert sum(e.length for e in merged) - sum(e.length for e in kept) == pytest.approx(
        sum(e.length for e in road), rel=0.02
    )
    assert report.elements["boundary"] == len(merged)


def test_the_order_of_the_maps_does_not_matter():
    rng = np.random.default_rng(6)
    truth = town(1)
    maps = [drive_map(truth, rng, offset=rng.normal(0, 0.5, 2)) for _ in range(4)]
    names = ["a", "b", "c", "d"]
    first, _ = merge_maps(maps, names)
    second, _ = merge_maps(maps[::-1], names[::-1])
    assert len(first) == len(second)
    for one, two in zip(first, second, strict=True):
        np.testing.assert_allclose(one.points, two.points, atol=1e-6)
        assert one.sources == two.sources
        assert one.observations == two.observations


def test_tiles_leave_no_seam():
    rng = np.random.default_rng(7)
    truth = town(2)
    maps = [drive_map(truth, rng) for _ in range(3)]
    whole, _ = merge_maps(maps, config=MergeConfig(tile=5000.0))
    tiled, report = merge_maps(maps, config=MergeConfig(tile=60.0))
    assert report.tiles > 20
    assert len(tiled) == pytest.approx(len(whole), abs=3)
    for kind in ElementKind:
        assert sum(e.length for e in tiled.of_kind(kind)) == pytest.approx(
            sum(e.length for e in whole.of_kind(kind)), rel=0.01
        )
        assert far_from(tiled.of_kind(kind), whole.of_kind(kind), 0.15) < 0.01
        assert far_from(whole.of_kind(kind), tiled.of_kind(kind), 0.15) < 0.01


def test_evidence_counts_for_and_against():
    road = [line([[0, 0], [200, 0], [200, 80]], BOUNDARY), line([[0, 7], [193, 7], [193, 80]], BOUNDARY)]
    paint = line([[0, 3.5], [150, 3.5]])
    ghost = line([[40, 2.0], [80, 2.0]], confidence=0.6)
    maps = [GlobalMap((*road, paint, *([ghost] if i == 0 else []))) for i in range(3)]
    maps = [GlobalMap(tuple(replace(e, points=e.points + 0.01 * i) for e in m)) for i, m in enumerate(maps)]
    merged, _ = merge_maps(maps)
    assert len(merged.of_kind(DIVIDER)) == 1
    (divider,) = merged.of_kind(DIVIDER)
    assert divider.observations == 27
    assert divider.confidence > paint.confidence
    sharp = replace(paint, deviation=np.full(2, 0.05), points=paint.points + np.array([0.0, 0.3]))
    blunt = replace(paint, deviation=np.full(2, 0.5))
    merged, _ = merge_maps([GlobalMap((*road, sharp)), GlobalMap((*road, blunt))])
    (divider,) = merged.of_kind(DIVIDER)
    assert np.median(divider.points[:, 1]) == pytest.approx(3.79, abs=0.02)


def test_double_lines_stay_double_and_cut_lines_become_one():
    road = [line([[0, y], [160, y]], BOUNDARY) for y in (-7, 7)]
    double = [line([[0, y], [160, y]]) for y in (-0.15, 0.15)]
    cut = [
        line([[0, -0.1], [90, -0.1]]),
        line([[60, 0.12], [160, 0.12]]),
        line([[90.5, -0.12], [160, -0.12]]),
        line([[60, 0.12], [0, 0.12]]),
    ]
    merged, _ = merge_maps([GlobalMap((*road, *double)), GlobalMap((*road, *cut))])
    assert len(merged.of_kind(DIVIDER)) == 2
    # each map saw a half: together a whole, in one piece
    halves = [GlobalMap((line([[0, 0], [100, 0.2]], BOUNDARY),)), GlobalMap((line([[80, 0.0], [200, 0.0]], BOUNDARY),))]
    merged, report = merge_maps(halves)
    (boundary,) = merged.of_kind(BOUNDARY)
    assert boundary.length == pytest.approx(200.0, abs=1.0)
    assert all("common ground" in status.note for status in report.maps)


def test_files_merge_with_provenance_and_a_copy_counts_once(tmp_path):
    rng = np.random.default_rng(8)
    plane, truth = LocalPlane(8.41, 49.01), town(1)
    maps = [drive_map(truth, rng) for _ in range(2)]
    paths = [tmp_path / name / "map.geojson" for name in ("log-1", "log-2", "copy")]
    for path, global_map in zip(paths, [*maps, maps[0]], strict=True):
        path.parent.mkdir()
        seen = observed_rings(near_elements(global_map), plane)
        write_map(global_map, path, plane, {"observed": seen})
    report = merge_files(paths, tmp_path / "city.geojson", executor=ProcessExecutor(2))
    assert len(report.duplicates) == 1
    city = read_map(tmp_path / "city.geojson", plane)
    assert sum(report.elements.values()) == len(city)
    assert city.provenance["sources"] == ["copy/map", "log-1/map", "log-2/map"]
    assert any(len(e.sources) == 2 for e in city)
    ground = shapely.buffer(shapely.union_all([near_elements(m) for m in maps]), -RIM)
    assert coverage(city, plane).symmetric_difference(ground).area < 0.1 * ground.area
    expected, _ = merge_maps(maps)
    assert city.length(BOUNDARY) == pytest.approx(expected.length(BOUNDARY), rel=0.01)


def test_the_merged_map_has_observed_what_any_drive_has_if_all_say_so(tmp_path):
    plane = LocalPlane(8.4, 49.0)
    grounds = [shapely.box(-20.0, -20.0, 80.0, 20.0), shapely.box(60.0, -20.0, 160.0, 30.0)]
    for number, ground in enumerate(grounds):
        kerb = line([[60.0 * number, 0.0], [60.0 * number + 70.0, 0.0]], BOUNDARY)
        told = {"observed": observed_rings(ground, plane)}
        write_map(GlobalMap((kerb,)), tmp_path / f"{number}.geojson", plane, told)
    write_map(GlobalMap((line([[0.0, 0.0], [50.0, 0.0]], BOUNDARY),)), tmp_path / "silent.geojson", plane)
    paths = [tmp_path / "0.geojson", tmp_path / "1.geojson"]
    merge_files(paths, tmp_path / "both.geojson")
    rings = read_map(tmp_path / "both.geojson", plane).provenance["observed"]
    together = ground_within([plane.from_wgs84(np.array(ring)) for ring in rings])
    assert together.symmetric_difference(shapely.union_all(grounds)).area < 5.0
    merge_files([*paths, tmp_path / "silent.geojson"], tmp_path / "all.geojson")
    assert "observed" not in read_map(tmp_path / "all.geojson", plane).provenance


def test_names_tell_files_apart(tmp_path):
    a, b = tmp_path / "a" / "map.geojson", tmp_path / "b" / "map.geojson"
    assert short_names([a, b]) == ["a/map", "b/map"]
    assert short_names([a]) == ["map"]
    with pytest.raises(ValueError, match="twice"):
        short_names([a, a])


def test_a_kerb_around_a_block_is_closed_however_the_drives_cut_it():
    corner = np.array([[0, 0], [130, 0], [130, 110], [0, 110], [0, 0]], dtype=float)
    ring = shapely.get_coordinates(shapely.segmentize(shapely.LineString(corner), 1.0))
    turns = [GlobalMap((line(np.roll(ring[:-1], k, axis=0)[:320], BOUNDARY),)) for k in (0, 130, 300)]
    merged, _ = merge_maps(turns)
    (kerb,) = merged.of_kind(BOUNDARY)
    np.testing.assert_allclose(kerb.points[0], kerb.points[-1], atol=1e-6)
    assert kerb.length == pytest.approx(480.0, abs=3.0)


@pytest.mark.parametrize("seed", [2])
def test_four_drives_together_are_better_than_one(seed):
    truth, road = town_road(np.random.default_rng(seed))
    poses = [road.pose(30.0 + 4.5 * number, -1.75) for number in range(40)]
    drives = [simulate(truth, poses, np.random.default_rng(100 + k)) for k in range(4)]
    rng = np.random.default_rng(seed)
    maps = []
    for drive in drives:
        integrator = MapIntegrator()
        for frame in drive.frames:
            integrator.add(frame)
        maps.append(integrator.map())
    offsets = [(rng.normal(0, 0.8, 2), np.radians(rng.normal(0, 0.15))) for _ in maps]
    centre = np.concatenate([e.points for e in truth]).mean(axis=0)
    moved = [
        GlobalMap(tuple(replace(e, points=move(e.points, centre, *offset)) for e in found))
        for found, offset in zip(maps, offsets, strict=True)
    ]
    merged, report = merge_maps(moved)
    assert all(status.partners == 3 for status in report.maps)
    back = align(landmarks(merged), landmarks(truth))
    merged = GlobalMap(tuple(replace(e, points=back.apply(e.points)) for e in merged))
    together, alone = measure(merged, drives[0]), [measure(found, drives[0]) for found in maps]
    assert together.precision >= np.mean([q.precision for q in alone]) - 0.002
    assert together.recall >= np.mean([q.recall for q in alone]) - 0.002
    assert together.lateral < 0.9 * np.mean([q.lateral for q in alone])
    assert together.elements_per_true <= 1.2
    assert together.ghosts_alive == 0


def kerbs(observations: int, **more) -> list[MapElement]:
    x = np.linspace(0.0, 60.0, 61)
    return [
        line(np.stack([x, y + np.sin(x / 9.0)], axis=1), BOUNDARY, observations=observations, **more)
        for y in (-5.0, 5.0)
    ]


def middle(**more) -> MapElement:
    return line([[5.0, 0.5], [55.0, 0.5]], **{"confidence": 0.95, "observations": 5, **more})


@pytest.mark.parametrize(("frames", "alive"), [(2, True), (60, False)])
def test_a_drive_that_looked_often_weighs_more_than_one_that_passed(frames, alive):
    """Two drives lack a line that one has: that is much if they saw the kerbs beside it in many frames."""
    having = GlobalMap((middle(), *kerbs(6)))
    lacking = [GlobalMap(tuple(kerbs(frames, confidence=c))) for c in (0.9, 0.91)]
    merged, _ = merge_maps([having, *lacking])
    assert (len(merged.of_kind(DIVIDER)) == 1) is alive
    assert len(merged.of_kind(BOUNDARY)) == 2


def test_one_frame_is_not_believed_more_than_one_frame_can_say():
    sure = MergeConfig()
    once, often = (certainty(middle(confidence=0.999, observations=n), sure) for n in (1, 10))
    assert once == pytest.approx(1.0)
    assert often == pytest.approx(sure.log_odds_limit)


def test_a_long_line_was_not_seen_as_a_whole_in_every_frame():
    x = np.linspace(0.0, 540.0, 100)
    looks = Looks([line(np.stack([x, 0 * x], axis=1), observations=100)])
    assert looks.at(np.array([[200.0, 5.0], [200.0, 40.0]])) == pytest.approx([10.0, 1.0])


def test_merged_elements_tell_their_drives_and_tracks(tmp_path):
    ring = [[20.0, -4.0], [24.0, -4.0], [24.0, 4.0], [20.0, 4.0], [20.0, -4.0]]
    first = GlobalMap((middle(track_ids=(3, 1)), *kerbs(6), line(ring, CROSSING, track_ids=(9,))))
    second = GlobalMap((middle(track_ids=(3,), confidence=0.94), *kerbs(7), line(ring, CROSSING, track_ids=(4,))))
    merged, _ = merge_maps([first, second], ["monday", "friday"])
    (divider,), (crossing,) = merged.of_kind(DIVIDER), merged.of_kind(CROSSING)
    assert divider.origins == {"friday": (3,), "monday": (1, 3)}
    assert crossing.origins == {"friday": (4,), "monday": (9,)}
    for name in ("map.geojson", "map.gpkg", "map.fgb"):
        write_map(merged, tmp_path / name, LocalPlane(8.0, 49.0))
        read = read_map(tmp_path / name, LocalPlane(8.0, 49.0))
        assert [e.origins for e in read] == [e.origins for e in merged]
    third = GlobalMap((middle(track_ids=(8,), sources=("may", "june"), source_track_ids=((8,), ())), *kerbs(5)))
    again, _ = merge_maps([merged, third], ["city", "summer"])
    assert again.of_kind(DIVIDER)[0].origins == {"friday": (3,), "june": (), "may": (8,), "monday": (1, 3)}


def test_one_integrator_of_two_drives_tells_them_apart():
    integrator = MapIntegrator()
    for log in ("monday", "friday"):
        for number in range(4):
            integrator.add(frame_map([[[-20, 2], [20, 2]]], number=number, tracks=[7 if log == "monday" else 1]), log)
    (element,) = integrator.map()
    assert element.origins == {"friday": (1,), "monday": (7,)}
    assert element.track_ids == (1, 7)
