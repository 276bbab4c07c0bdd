"""The map integrator: tracked polylines of single frames in, one global map with evidence out."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from mapfusion.association import Candidate, assign, candidates, gather
from mapfusion.cleaning import line_elements, ring_elements
from mapfusion.config import IntegratorConfig
from mapfusion.elements import ElementKind, FrameMap, GlobalMap, MapElement
from mapfusion.joining import join
from mapfusion.journal import Journal
from mapfusion.lines import Curve, Evidence, FusedLine, beside, fuse
from mapfusion.matching import Correspondence
from mapfusion.observations import Observation, observe, pose_problem
from mapfusion.rings import (
    FusedRing,
    RingSighting,
    fuse_ring,
    merge_rings,
    new_ring,
    overlap,
    ring_match_threshold,
    room_of,
    sight,
)
from mapfusion.spatial import TileIndex
from mapfusion.state import load_state, save_state
from mapfusion.views import ViewGrid, clearly_visible
from mapfusion.visibility import ground_problem

Float = NDArray[np.float64]


class MapIntegrator:
    """Fuses the maps of single frames into one global map.

    Frames may come in any order and from several logs. What a frame costs depends on what lies around the car,
    not on the size of the map.

    Attributes:
        config: assumptions about the detector.
        rejections: what was left out and why, counted by reason.

    Example:
        >>> integrator = MapIntegrator()
        >>> len(integrator.map())
        0
    """

    def __init__(self, config: IntegratorConfig | None = None) -> None:
        self.config = config or IntegratorConfig()
        self.rejections: Counter[str] = Counter()
        self.journal = Journal()
        self.views = ViewGrid(self.config)
        self.lines: dict[int, FusedLine] = {}
        self.rings: dict[int, FusedRing] = {}
        self.index = TileIndex()
        self.next_id = 0
        self.frames = 0
        self._clean: dict[int, list[MapElement]] = {}
        self._dirty: set[int] = set()

    def add(self, frame_map: FrameMap, log: str = "") -> None:
        """Fuse the tracked elements of one frame.

        Broken input (poses, points, scores) is counted in :attr:`rejections` and changes nothing else. A frame of
        the same log and timestamp as an earlier one adds no evidence and is left out, too.

        Args:
            frame_map: what the mapper saw.
            log: name of the drive; poses are checked against other frames of the same drive only, and equal track
                ids of two drives are two tracks.
        """
        problem = (
            pose_problem(frame_map.ego_to_global)
            or ground_problem(frame_map)
            or self.journal.enter(log, frame_map.timestamp, frame_map.ego_to_global[:2, 3], self.config.max_speed)
        )
        if problem is not None:
            self.rejections[problem] += 1
            return
        visible = clearly_visible(frame_map)
        lines, rings = observe(frame_map, self.config, self.rejections, log, visible)
        self.frames += 1
        self.views.add(frame_map.ego_to_global, frame_map.roi, visible)
        reach = np.abs(frame_map.ego_to_global[:2, :2]) @ (frame_map.roi.size / 2) + 2.0
        low, high = frame_map.ego_to_global[:2, 3] - reach, frame_map.ego_to_global[:2, 3] + reach
        near = self.index.near(low, high)
        self._dirty.update(near)
        for kind in (ElementKind.DIVIDER, ElementKind.BOUNDARY):
            known = {i: self.lines[i] for i in near if i in self.lines and self.lines[i].kind is kind}
            self._add_lines([o for o in lines if o.kind is kind], known, low, high, frame_map.timestamp)
        self._add_rings(rings, [i for i in near if i in self.rings], frame_map, visible)

    def map(self) -> GlobalMap:
        """Return the map as it stands; only what changed since the last call is computed."""
        for element in self._dirty:
            if element in self.lines:
                self._clean[element] = line_elements(self.lines[element], self.views, self.config)
            elif element in self.rings:
                self._clean[element] = ring_elements(self.rings[element], self.views, self.config)
            else:
                self._clean.pop(element, None)
        self._dirty.clear()
        elements = [element for key in sorted(self._clean) for element in self._clean[key]]
        return GlobalMap(
            tuple(join(elements, self.views, self.config)), {"frames": self.frames, "integrator": asdict(self.config)}
        )

    def save(self, path: Path) -> None:
        """Write the state to a ``.npz`` file, to go on later with :meth:`load`; raises OSError."""
        save_state(self, path)

    @classmethod
    def load(cls, path: Path) -> MapIntegrator:
        """Return the integrator that :meth:`save` wrote; raises ValueError for other files, OSError."""
        integrator = cls()
        load_state(integrator, path)
        return integrator

    def put_line(self, element: int, line: FusedLine) -> None:
        """File a line under an id of its own."""
        self.lines[element] = line
        self.index.put(element, line.curve.points)
        self._dirty.add(element)

    def put_ring(self, element: int, ring: FusedRing) -> None:
        """File a crossing under an id of its own."""
        self.rings[element] = ring
        self._file_ring(element)

    def _add_lines(
        self, observations: list[Observation], known: dict[int, FusedLine], low: Float, high: Float, timestamp: int
    ) -> None:
        if not observations:
            return
        local = gather(known, low, high)
        options: list[list[Candidate]] = [
            candidates(observation, known, local, low, self.config) if local is not None else []
            for observation in observations
        ]
        chosen = assign([{c.element: c.benefit for c in row} for row in options])
        taken: dict[int, set[int]] = {}
        leftovers: list[tuple[Observation, Curve]] = []
        touched: set[int] = set()
        merges: list[tuple[int, int]] = []
        order = sorted(range(len(observations)), key=lambda i: chosen[i] is None)
        for i in order:
            own = [c for c in options[i] if c.element == chosen[i]]
            if not own:
                own = [c for c in options[i] if _mostly_free(c, taken)][:1]
            if not own:
                leftovers.append((observations[i], _curve(observations[i])))
                continue
            candidate = own[0]
            for other in options[i]:
                if other.element == candidate.element:
                    continue
                if other.element in chosen and not _mostly_free(other, taken):
                    _note_beside(self.lines, candidate.element, other.element)
                else:
                    merges.append((candidate.element, other.element))
            taken.setdefault(candidate.element, set()).update(candidate.match.station.tolist())
            if candidate.element in touched:
                # the stations have moved since; match again
                match = beside(
                    self.lines[candidate.element].curve,
                    _curve(observations[i]),
                    1.5 * self.config.match_distance,
                    self.config.match_angle,
                )
                if not len(match.station):
                    continue
            else:
                match = candidate.match
            pieces = self._fuse_line(candidate.element, observations[i], match, timestamp, candidate.element in touched)
            touched.add(candidate.element)
            leftovers.extend((observations[i], piece) for piece in pieces)
        for observation, piece in leftovers:
            if len(piece) >= 3:
                self._new_line(observation, piece, timestamp)
        for first, second in merges:
            self._merge_lines(first, second)

    def _fuse_line(
        self, element: int, observation: Observation, match: Correspondence, timestamp: int, again: bool
    ) -> list[Curve]:
        line = self.lines[element]
        line.curve, pieces = fuse(line.curve, _curve(observation), match)
        line.evidence.sighted(observation.track, timestamp, again)
        self.index.put(element, line.curve.points)
        self._dirty.add(element)
        return pieces

    def _new_line(self, observation: Observation, curve: Curve, timestamp: int) -> None:
        evidence = Evidence(timestamp, timestamp, tracks={observation.track: 1})
        self.put_line(self.next_id, FusedLine(observation.kind, curve, evidence))
        self.next_id += 1

    def _merge_lines(self, first: int, second: int) -> None:
        """Make one line of two, unless single frames have shown both side by side."""
        if first == second or first not in self.lines or second not in self.lines:
            return
        keep, drop = min(first, second), max(first, second)
        base, other = self.lines[keep], self.lines[drop]
        fewer = min(base.evidence.observations, other.evidence.observations)
        if base.evidence.beside.get(drop, 0) > 0.25 * fewer:
            return
        match = beside(base.curve, other.curve, self.config.match_distance, self.config.match_angle)
        if len(match.station) < 2 or match.distance.mean() > self.config.merge_distance:
            return
        base.curve, pieces = fuse(base.curve, other.curve, match)
        base.evidence.absorb(other.evidence)
        self._dirty.update((keep, drop))
        self.index.put(keep, base.curve.points)
        self.index.remove(drop)
        del self.lines[drop]
        for piece in pieces:
            if len(piece) >= 3:
                evidence = Evidence(
                    other.evidence.first_seen,
                    other.evidence.last_seen,
                    other.evidence.observations,
                    dict(other.evidence.tracks),
                )
                self.put_line(self.next_id, FusedLine(other.kind, piece, evidence))
                self.next_id += 1

    def _add_rings(
        self, observations: list[Observation], near: list[int], frame_map: FrameMap, visible: shapely.Geometry | None
    ) -> None:
        cell = self.config.ring_cell
        rooms = [room_of(observation.points, cell) for observation in observations]
        sightings: list[RingSighting] = []
        options: list[dict[int, float]] = []
        for observation, (low, high) in zip(observations, rooms, strict=True):
            around = [i for i in near if (self.rings[i].corner < high).all() and (self.rings[i].stop > low).all()]
            wide_low = np.min([low, *(self.rings[i].corner for i in around)], axis=0)
            wide_high = np.max([high, *(self.rings[i].stop for i in around)], axis=0)
            room = wide_low, wide_high
            sighting = sight(observation, room, frame_map.ego_to_global, frame_map.roi, cell, visible)
            shares = {i: overlap(self.rings[i], sighting) for i in around}
            sightings.append(sighting)
            options.append(
                {i: s for i, s in shares.items() if s > ring_match_threshold(self.rings[i], observation, self.config)}
            )
        chosen = assign(options)
        for sighting, (low, high), row, element in zip(sightings, rooms, options, chosen, strict=True):
            if element is None:
                self.put_ring(self.next_id, new_ring(sighting.crop(low, high), frame_map.timestamp))
                self.next_id += 1
                continue
            ring = self.rings[element]
            room = np.minimum(low, ring.corner), np.maximum(high, ring.stop)
            fuse_ring(ring, sighting.crop(*room), frame_map.timestamp)
            for other in row:
                if other != element and other not in chosen and other in self.rings:
                    self._merge_rings(element, other)
            self._file_ring(element)

    def _merge_rings(self, keep: int, drop: int) -> None:
        """Make one crossing of two that cover much the same ground."""
        first, second = self.rings[keep], self.rings[drop]
        low, high = np.maximum(first.corner, second.corner), np.minimum(first.stop, second.stop)
        if (high <= low).any():
            return
        one, two = first.level(first.window(low, high)) > 0, second.level(second.window(low, high)) > 0
        if np.count_nonzero(one & two) < self.config.ring_overlap * np.count_nonzero(one | two):
            return
        merge_rings(first, self.rings.pop(drop))
        self.index.remove(drop)
        self._dirty.add(drop)

    def _file_ring(self, element: int) -> None:
        ring = self.rings[element]
        corners = np.array([ring.corner, ring.stop, [ring.corner[0], ring.stop[1]], [ring.stop[0], ring.corner[1]]])
        self.index.put(element, np.vstack([corners, corners.mean(axis=0)]) * self.config.ring_cell)
        self._dirty.add(element)


def _curve(observation: Observation) -> Curve:
    count = len(observation.points)
    return Curve(observation.points, observation.information, np.full(count, observation.sighting), observation.view)


def _mostly_free(candidate: Candidate, taken: dict[int, set[int]]) -> bool:
    stations = taken.get(candidate.element)
    return stations is None or len(stations.intersection(candidate.match.station.tolist())) < 0.3 * candidate.overlap


def _note_beside(lines: dict[int, FusedLine], first: int, second: int) -> None:
    for one, other in ((first, second), (second, first)):
        counts = lines[one].evidence.beside
        counts[other] = counts.get(other, 0) + 1
