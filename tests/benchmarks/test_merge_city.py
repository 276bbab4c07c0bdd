"""A city of a thousand drives: how long merging takes, what it needs, and whether the map is right.

``PREDMAPNET_MERGE_DRIVES`` sets another number of drives.
"""

from __future__ import annotations

import os
import resource
import time

import numpy as np
import pytest
import shapely

from mapfusion import ElementKind, GlobalMap, MapElement
from mapfusion.alignment import move
from mapfusion.formats.by_suffix import read_map, write_map
from mapfusion.formats.local_plane import LocalPlane
from mapfusion.geometry import arc_length
from mapfusion.merge.merge import merge_files
from predmapnet.runs.process_executor import ProcessExecutor

pytestmark = pytest.mark.benchmark_only

BLOCK = 150.0
PLANE = LocalPlane(8.4, 49.0)


def city(blocks: int) -> list[MapElement]:
    """A grid of slightly bent streets: kerbs round the blocks, a line in the middle, crossings at each junction."""
    elements = []

    def bend(points):
        return points + 6.0 * np.sin(points[:, ::-1] / 140.0)

    def add(kind, points):
        dense = shapely.get_coordinates(shapely.segmentize(shapely.LineString(points), 5.0))
        elements.append(MapElement(kind, bend(dense), 0.9, 10, 10**18, 10**18))

    for i in range(blocks):
        for j in range(blocks):
            low, high = np.array([i, j]) * BLOCK + 7.0, np.array([i + 1, j + 1]) * BLOCK - 7.0
            (a, b), (c, d) = low, high
            add(ElementKind.BOUNDARY, [[a, b], [c, b], [c, d], [a, d], [a, b]])
            add(ElementKind.DIVIDER, [[a + 4, b - 7], [c - 4, b - 7]])
            add(ElementKind.DIVIDER, [[a - 7, b + 4], [a - 7, d - 4]])
            add(ElementKind.PED_CROSSING, [[a + 1, b - 14], [a + 4, b - 14], [a + 4, b], [a + 1, b], [a + 1, b - 14]])
    return elements


def drive(truth: list[MapElement], tree: shapely.STRtree, blocks: int, rng: np.random.Generator) -> GlobalMap:
    """What a drive of four blocks saw within 15 m, with its own pose error and noise."""
    at = rng.integers(0, blocks, 2)
    corners = [at.copy()]
    for _ in range(4):
        at = np.clip(at + np.eye(2, dtype=int)[rng.integers(2)] * rng.choice([-1, 1]), 0, blocks)
        corners.append(at.copy())
    path = shapely.LineString(np.array(corners) * BLOCK + rng.normal(0, 0.1, (5, 2)))
    seen = shapely.buffer(path, 18.0)
    shift, turn = rng.normal(0, 0.8, 2), np.radians(rng.normal(0, 0.1))
    centre = shapely.get_coordinates(path).mean(axis=0)
    elements = []
    for row in sorted(tree.query(seen, predicate="intersects").tolist()):
        element = truth[row]
        ring = element.kind.is_ring
        parts = (
            [shapely.LineString(element.points)]
            if ring
            else shapely.get_parts(shapely.line_merge(shapely.intersection(shapely.LineString(element.points), seen)))
        )
        for part in parts:
            if rng.random() < 0.1 or part.length < 4.0 or (ring and not seen.covers(part)):
                continue
            points = shapely.get_coordinates(part)
            wave = np.sin(arc_length(points) / 25.0 + rng.uniform(0, 6))[:, None] * rng.normal(0, 0.1, 2)
            points = move(points + (0.0 if ring else wave) + rng.normal(0, 0.1, 2), centre, shift, turn)
            elements.append(
                MapElement(element.kind, points, rng.uniform(0.7, 0.98), int(rng.integers(3, 20)), 10**18, 10**18)
            )
    return GlobalMap(tuple(elements))


def test_merging_a_city(tmp_path, capsys):
    drives = int(os.environ.get("PREDMAPNET_MERGE_DRIVES", "1000"))
    rng = np.random.default_rng(0)
    blocks = max(2, round(np.sqrt(drives / 2.5)))
    truth = city(blocks)
    tree = shapely.STRtree([shapely.LineString(e.points) for e in truth])
    paths = []
    for number in range(drives):
        global_map = drive(truth, tree, blocks, rng)
        if len(global_map):
            paths.append(tmp_path / f"drive-{number:04d}.geojson")
            write_map(global_map, paths[-1], PLANE)
    start = time.perf_counter()
    report = merge_files(paths, tmp_path / "city.geojson", executor=ProcessExecutor(2))
    seconds = time.perf_counter() - start
    peak = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)) / 1024
    merged = read_map(tmp_path / "city.geojson", PLANE)
    lines = [e for e in merged if not e.kind.is_ring]
    samples = np.concatenate(
        [shapely.get_coordinates(shapely.segmentize(shapely.LineString(e.points), 2.0)) for e in lines]
    )
    true = shapely.STRtree([shapely.LineString(e.points) for e in truth if not e.kind.is_ring])
    points = shapely.points(samples)
    distance = shapely.distance(points, true.geometries[true.nearest(points)])
    aligned = sum(status.partners > 0 for status in report.maps)
    with capsys.disabled():
        print(
            f"\n{len(paths)} maps, {blocks} x {blocks} blocks, {report.tiles} tiles: {seconds:.0f} s, {peak:.0f} MB, "
            f"{aligned} aligned, {report.elements}, off by {np.median(distance):.3f} m (median), "
            f"{100 * (distance > 0.5).mean():.2f} % beyond 0.5 m"
        )
    assert aligned > 0.9 * len(paths)
    assert np.median(distance) < 0.25
    assert (distance > 1.0).mean() < 0.02
    assert len(lines) < 1.6 * sum(not e.kind.is_ring for e in truth)
