"""Merge of the maps of many drives: poses corrected between drives, evidence added up, tile by tile."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import shapely
from scipy.special import expit

from mapfusion.alignment import Alignment, align
from mapfusion.arrays import Float
from mapfusion.elements import ElementKind, GlobalMap, MapElement
from mapfusion.executors import Executor, Sequential, results_in_order
from mapfusion.formats.by_suffix import MapWriter, check_frames, frame_of, read_box
from mapfusion.formats.local_plane import LocalPlane, common_plane
from mapfusion.geometry import arc_length, simplified_rows
from mapfusion.georeference import InvertibleGeoreference
from mapfusion.ground import coverage, ground_within, rings_around
from mapfusion.line_repair import repaired_rows
from mapfusion.merge.choice import Choice, LookedAt, choose, looked_at
from mapfusion.merge.config import MergeConfig
from mapfusion.merge.corrections import Correction, solve_corrections
from mapfusion.merge.map_cache import MapCache
from mapfusion.merge.report import MapStatus, MergeReport, notes_of_copies, short_names
from mapfusion.merge.tile_fusion import fuse_tile, named
from mapfusion.merge.tiles import MergedLine, Stitcher, Tile, tiles_of
from mapfusion.provenance import united_provenance
from mapfusion.road_heights import filled, rises

Progress = Callable[[int, int, str], None]
"""Called as ``progress(done, in all, what)``."""

NEIGHBOURS = 4
"""Number of neighbouring tasks that one worker does one after the other, since they need the same maps."""

_Task = TypeVar("_Task")
_FusedTile = tuple[list[MergedLine], list[MapElement]]
"""Lines of a tile, cut at its sides, and its crossings."""


@dataclass(frozen=True)
class _MapSummary:
    """Summary of a map while it is not in memory."""

    name: str
    place: int
    low: Float
    high: Float
    evidence: float
    digest: str
    observed: list[list[list[float]]] | None
    notes: tuple[str, ...]
    frame: str
    origin: str

    @property
    def centre(self) -> Float:
        return (self.low + self.high) / 2


@dataclass(frozen=True)
class _Aligning:
    """Work of the alignment: called in a worker, it opens the maps and returns what aligns some of them with others."""

    maps: Sequence[GlobalMap] | Sequence[Path]
    plane: InvertibleGeoreference | None

    def __call__(self) -> Callable[[Sequence[tuple[int, list[int]]]], list[tuple[int, int, Alignment]]]:
        cache = MapCache(self.maps, self.plane)
        return lambda tasks: [found for task in tasks for found in _align_with(cache, *task)]


@dataclass(frozen=True)
class _Fusing:
    """Work of the fusion: called in a worker, it opens the maps and returns what fuses tile after tile."""

    maps: Sequence[GlobalMap] | Sequence[Path]
    plane: InvertibleGeoreference | None
    corrections: dict[int, Correction]
    names: list[str]
    config: MergeConfig

    def __call__(self) -> Callable[[Sequence[tuple[Tile, list[int]]]], list[_FusedTile]]:
        cache = MapCache(self.maps, self.plane)
        cache.corrections = self.corrections
        return lambda tasks: [_fuse_tile(cache, tile, places, self.names, self.config) for tile, places in tasks]


def merge_maps(
    maps: Sequence[GlobalMap],
    names: Sequence[str] | None = None,
    config: MergeConfig | None = None,
    plane: InvertibleGeoreference | None = None,
) -> tuple[GlobalMap, MergeReport]:
    """Merge maps of one place that are in memory and in one metric frame.

    The result does not depend on the order of the maps.

    Args:
        maps: metres.
        names: of the maps, all different; ``map 0``, ``map 1`` ... without.
        config: what is assumed.
        plane: leads from degrees to that frame, for maps that say what ground they observed.

    Returns:
        The merged map; each element's ``sources`` name the drives it comes from, or the maps if those do not name any.
        And the report on the maps.
    """
    names = list(names) if names is not None else [f"map {i}" for i in range(len(maps))]
    merge = _Merge(MapCache(maps, plane), names, config or MergeConfig())
    elements = tuple(merge.elements(Sequential(), None))
    return GlobalMap(elements, {"sources": merge.sources}), merge.report()


def merge_files(
    paths: Sequence[Path],
    out: Path,
    config: MergeConfig | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
    provenance: dict[str, Any] | None = None,
    crs: str | None = None,
) -> MergeReport:
    """Merge map files of one city into one file; what is held in memory depends on the tiles, not on the city.

    Args:
        paths: maps to merge.
        out: file to write; a GeoJSON file is written as the tiles are done, other formats at the end.
        config: what is assumed.
        executor: aligns and fuses; everything is done here, one after the other, without.
        progress: called as the work goes on.
        provenance: what else the file should tell of its origin.
        crs: reference system of the file, as of :func:`mapfusion.formats.by_suffix.write_map`.

    Raises:
        ValueError: a file that is not a map, maps that lie too far apart, or two maps of the same name.
        OSError: a file cannot be read or written.
    """
    boxes = [box for box in (read_box(path) for path in paths) if box is not None]
    plane = common_plane(np.array(boxes)) if boxes else LocalPlane(0.0, 0.0)
    names = short_names(paths)
    merge = _Merge(MapCache(list(paths), plane), names, config or MergeConfig())
    told = {**merge.provenance, "generator": "predmapnet merge", "sources": merge.sources, **(provenance or {})}
    observed = merge.observed()
    if observed is not None:
        told["observed"] = observed
    with MapWriter(out, plane, told, crs) as writer:
        for element in merge.elements(executor or Sequential(), progress):
            writer.write(element)
    return merge.report()


class _Merge:
    """One merge, from the maps to the elements of the result."""

    def __init__(self, cache: MapCache, names: Sequence[str], config: MergeConfig) -> None:
        self.cache = cache
        self.config = config
        summaries, looked = self._looked_through(names)
        entries = sorted(summaries.values(), key=lambda entry: (-entry.evidence, entry.digest, entry.name))
        first: dict[str, _MapSummary] = {}
        for entry in entries:
            first.setdefault(entry.digest, entry)
        check_frames((entry.name, entry.frame) for entry in entries)
        self.choice = self._chosen(list(first.values()), looked)
        left = {one.name for one in self.choice if not one.taken}
        left |= {entry.name for entry in entries if first[entry.digest].name in left}
        self.entries = [entry for entry in first.values() if entry.name not in left]
        entries = [entry for entry in entries if entry.name not in left]
        self.duplicates = tuple(sorted(entry.name for entry in entries if first[entry.digest] is not entry))
        self.sources = sorted(set(names) - left)
        self.provenance = united_provenance(told for name, told in self._told.items() if name not in left)
        self.notes = tuple((entry.name, note) for entry in entries for note in entry.notes)
        self.notes += notes_of_copies((entry.name, entry.origin) for entry in self.entries)
        self.empty = sorted(set(names) - summaries.keys())
        self.names = list(names)
        self.statuses: list[MapStatus] = [MapStatus(name, Correction(), 0, "the map is empty") for name in self.empty]
        self.counts = {kind.label: 0 for kind in ElementKind}
        self.metres = {kind.label: 0.0 for kind in ElementKind}
        self.tile_count = 0

    def _looked_through(self, names: Sequence[str]) -> tuple[dict[str, _MapSummary], dict[str, LookedAt]]:
        """Look at every map once: what those are that hold something, and, for a choice, where they looked."""
        self._told: dict[str, Mapping[str, Any]] = {}
        summaries, looked = {}, {}
        for place, name in enumerate(names):
            raw = self.cache.raw(place)
            self._told[name] = raw.provenance
            summary = _summary(raw, place, name)
            if summary is not None:
                summaries[name] = summary
                if self.config.at_most is not None:
                    looked[name] = looked_at(raw, coverage(raw, self.cache.plane))
        return summaries, looked

    def _chosen(self, entries: Sequence[_MapSummary], looked: Mapping[str, LookedAt]) -> tuple[Choice, ...]:
        if self.config.at_most is None or len(entries) <= self.config.at_most:
            return ()
        names = [entry.name for entry in entries]
        return tuple(choose(names, [looked[name] for name in names], self.config.at_most))

    def observed(self) -> list[list[list[float]]] | None:
        """Return the ground that the maps together have observed, rings in degrees, if each of them says its own."""
        if not self.entries or not all(entry.observed for entry in self.entries):
            return None
        grounds = [ground_within([np.array(ring) for ring in entry.observed or ()]) for entry in self.entries]
        return [np.round(ring, 7).tolist() for ring in rings_around(shapely.union_all(grounds))]

    def elements(self, executor: Executor, progress: Progress | None) -> Iterator[MapElement]:
        """Correct the poses, then yield the elements of the result in the order of the tiles."""
        say = progress or (lambda done, total, what: None)
        apart = self._correct(executor, say)
        fused = [entry for entry in self.entries if entry.place not in apart]
        for element in self._fused(fused, executor, say):
            yield self._counted(element)
        for entry in self.entries:
            if entry.place in apart:
                for element in self.cache.raw(entry.place):
                    yield self._counted(named(element, entry.name))

    def report(self) -> MergeReport:
        """Return the report, once all elements were taken."""
        statuses = tuple(sorted(self.statuses, key=lambda status: status.name))
        return MergeReport(
            statuses, self.duplicates, self.counts, self.metres, self.tile_count, self.notes, self.choice
        )

    def _counted(self, element: MapElement) -> MapElement:
        self.counts[element.kind.label] += 1
        self.metres[element.kind.label] += element.extent[0]
        return element

    def _correct(self, executor: Executor, say: Progress) -> set[int]:
        """Align the maps with each other; returns those that contradict the others."""
        tasks = _partners(self.entries, self.config.max_partners)
        found: dict[tuple[int, int], Alignment] = {}
        groups, done = _groups(tasks), 0
        aligning = _Aligning(self.cache.maps, self.cache.plane)
        for group, row in zip(groups, results_in_order(executor, aligning, groups), strict=True):
            found.update({(first, second): alignment for first, second, alignment in row})
            done += len(group)
            say(done, len(tasks), "aligning")
        number = {entry.place: i for i, entry in enumerate(self.entries)}
        certain = {(number[a], number[b]): alignment for (a, b), alignment in found.items() if alignment.certain}
        centres = np.array([entry.centre for entry in self.entries]).reshape(-1, 2)
        corrections = solve_corrections(centres, certain)
        apart: set[int] = set()
        for i, (entry, correction) in enumerate(zip(self.entries, corrections, strict=True)):
            own = [alignment for pair, alignment in found.items() if entry.place in pair]
            partners = sum(i in pair for pair in certain)
            doubts = sorted(own, key=lambda alignment: (-alignment.overlap, alignment.refusal))
            note, contradicts = "", False
            if not own:
                note = "no other map of this place"
            elif not partners:
                note, contradicts = doubts[0].refusal, doubts[0].disagrees
            if contradicts:
                apart.add(entry.place)
            if partners:
                self.cache.corrections[entry.place] = correction
            self.statuses.append(MapStatus(entry.name, correction, partners, note, contradicts))
        return apart

    def _fused(self, entries: list[_MapSummary], executor: Executor, say: Progress) -> Iterator[MapElement]:
        reach = self.config.margin + 6.0
        members: dict[Tile, list[int]] = {}
        for entry in entries:
            for tile in tiles_of(entry.low - reach, entry.high + reach, self.config.tile):
                members.setdefault(tile, []).append(entry.place)
        tiles = sorted(members)
        self.tile_count = len(tiles)
        stitcher = Stitcher(tiles)
        groups = _groups([(tile, members[tile]) for tile in tiles])
        fusing = _Fusing(self.cache.maps, self.cache.plane, self.cache.corrections, self.names, self.config)
        results = (fused for group in results_in_order(executor, fusing, groups) for fused in group)
        for done, (tile, (lines, rings)) in enumerate(zip(tiles, results, strict=True), start=1):
            for line in stitcher.add(tile, lines):
                yield from self._finished(line)
            yield from rings
            say(done, len(tiles), "merging tiles")
        for line in stitcher.rest():
            yield from self._finished(line)

    def _finished(self, line: MergedLine) -> Iterator[MapElement]:
        rows = repaired_rows(line.points)
        points, values = line.points[rows], line.values[rows]
        if len(rows) < 2 or shapely.LineString(points).length < self.config.min_length:
            return
        kept = simplified_rows(points, self.config.simplify_tolerance)
        heights = filled(values[:, 2], points)
        if heights is not None:
            kept = np.union1d(kept, rises(arc_length(points), heights))
        element = MapElement(
            kind=line.kind,
            points=points[kept],
            confidence=float(expit(np.clip(values[:, 1], -6.0, 6.0)).mean()),
            observations=sum(line.observations.values()),
            first_seen=line.first_seen,
            last_seen=line.last_seen,
            deviation=np.sqrt(values[kept, 0]),
            heights=None if heights is None else heights[kept],
            name=line.name,
            paint=line.paint,
        )
        yield element.with_origins(line.origins)


def _groups(tasks: list[_Task]) -> list[list[_Task]]:
    return [tasks[first : first + NEIGHBOURS] for first in range(0, len(tasks), NEIGHBOURS)]


def _summary(raw: GlobalMap, place: int, name: str) -> _MapSummary | None:
    """Look at a map once, before anything is merged; None for an empty one."""
    if not len(raw):
        return None
    points = np.concatenate([element.points for element in raw])
    if not np.isfinite(points).all():
        raise ValueError(f"{name}: a point is not finite")
    digest = hashlib.sha256()
    for row in sorted((int(e.kind), e.confidence, e.observations, np.round(e.points, 4).tobytes()) for e in raw):
        digest.update(repr(row).encode())
    evidence = sum(element.length * element.observations for element in raw)
    low, high = points.min(axis=0), points.max(axis=0)
    observed = raw.provenance.get("observed")
    told = repr(sorted(raw.provenance.items()))
    origin = hashlib.sha256(told.encode()).hexdigest() if "created" in raw.provenance else name
    return _MapSummary(
        name, place, low, high, round(evidence, 3), digest.hexdigest(), observed, raw.notes, frame_of(raw), origin
    )


def _partners(entries: Sequence[_MapSummary], most: int) -> list[tuple[int, list[int]]]:
    """Return for each map those that it shares ground with and comes before, neighbours after neighbours."""
    boxes = [shapely.box(*(entry.low - 5.0), *(entry.high + 5.0)) for entry in entries]
    chosen: set[tuple[int, int]] = set()
    if len(entries) > 1:
        rows, others = shapely.STRtree(boxes).query(boxes, predicate="intersects")
        for row in range(len(entries)):
            near = [int(other) for other in others[rows == row] if other != row]
            area = {other: round(shapely.intersection(boxes[row], boxes[other]).area, 3) for other in near}
            best = sorted(near, key=lambda other: (-area[other], other))[:most]
            chosen.update((min(row, other), max(row, other)) for other in best)
    tasks = [
        (entry.place, [entries[b].place for a, b in sorted(chosen) if a == row]) for row, entry in enumerate(entries)
    ]
    spot = {entry.place: tuple(np.floor(entry.centre / 200.0)[::-1].tolist()) for entry in entries}
    return sorted((task for task in tasks if task[1]), key=lambda task: spot[task[0]])


def _align_with(cache: MapCache, place: int, others: Sequence[int]) -> list[tuple[int, int, Alignment]]:
    """Align one map with each of several others."""
    source = cache.landmarks(place)
    return [(place, other, align(source, cache.landmarks(other))) for other in others]


def _fuse_tile(
    cache: MapCache, tile: Tile, places: Sequence[int], names: Sequence[str], config: MergeConfig
) -> _FusedTile:
    """Fuse what the maps have in a tile."""
    return fuse_tile(tile, [(names[place], place, *cache.corrected(place)) for place in places], config)
