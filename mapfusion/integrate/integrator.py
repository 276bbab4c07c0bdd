"""The map integrator: tracked polylines of single frames in, one global map with evidence out."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from mapfusion.elements import ElementKind, FrameMap, GlobalMap, MapElement
from mapfusion.geometry import rigid_pose_problem
from mapfusion.ground import ground_problem
from mapfusion.integrate.assembly import Assembly
from mapfusion.integrate.association import Candidate, assign, candidates, gather
from mapfusion.integrate.config import IntegratorConfig
from mapfusion.integrate.curve import Curve
from mapfusion.integrate.evidence import Evidence, Track
from mapfusion.integrate.extraction import line_elements, ring_elements
from mapfusion.integrate.frame_log import Journal
from mapfusion.integrate.fused_line import FusedLine, beside, fuse
from mapfusion.integrate.fused_ring import (
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
from mapfusion.integrate.observations import Observation, observe
from mapfusion.integrate.state import load_state, save_state
from mapfusion.integrate.tile_index import TileIndex
from mapfusion.integrate.uncertainty import PRIOR_SHARES, PROBE_SPACING, ErrorModel
from mapfusion.integrate.views import ViewGrid, clearly_visible

Float = NDArray[np.float64]


STALE = 0.1
"""The uncertainty of the whole map is computed anew when what is known of the detector's error changed by more."""


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
        self.errors = ErrorModel()
        self._parts = PRIOR_SHARES
        self._dirty: set[int] = set()
        self._assembly = Assembly()
        self._elements: tuple[MapElement, ...] = ()

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
            rigid_pose_problem(frame_map.ego_to_global)
            or ground_problem(frame_map)
            or self.journal.enter(log, frame_map.timestamp, frame_map.ego_to_global[:2, 3], self.config.max_speed)
        )
        if problem is not None:
            self.rejections[problem] += 1
            return
        car = frame_map.ego_to_global[:2, 3]
        visible = clearly_visible(frame_map)
        lines, rings = observe(frame_map, self.config, self.rejections, self.journal.book(log).number, visible)
        self.frames += 1
        self.views.add(frame_map.ego_to_global, frame_map.roi, visible)
        reach = np.abs(frame_map.ego_to_global[:2, :2]) @ (frame_map.roi.size / 2) + 2.0
        instant = _Instant(frame_map.timestamp, (float(car[0]), float(car[1])), car - reach, car + reach)
        near = self.index.near(instant.low, instant.high)
        self._dirty.update(near)
        self._assembly.looked_at(instant.low, instant.high, self.config)
        for kind in (ElementKind.DIVIDER, ElementKind.BOUNDARY):
            known = {i: self.lines[i] for i in near if i in self.lines and self.lines[i].kind is kind}
            self._add_lines([o for o in lines if o.kind is kind], known, instant)
        self._add_rings(rings, [i for i in near if i in self.rings], frame_map, visible)

    def map(self) -> GlobalMap:
        """Return the map as it stands; only what changed since the last call is computed."""
        if self._dirty:
            self._refresh()
        return GlobalMap(self._elements, {"frames": self.frames, "integrator": asdict(self.config)})

    def _refresh(self) -> None:
        parts = self.errors.parts()
        if np.abs(parts - self._parts).sum() > STALE * self._parts.sum():
            self._parts = parts
            self._dirty.update(self.lines, self.rings)
        logs = {book.number: log for log, book in self.journal.logs.items()}
        for element in self._dirty:
            if element in self.lines:
                found = line_elements(self.lines[element], self.views, self._parts, self.config, logs)
            elif element in self.rings:
                found = ring_elements(self.rings[element], self.views, self._parts, self.config, logs)
            else:
                found = []
            self._assembly.put(element, found)
        self._dirty.clear()
        self._elements = self._assembly.elements(self.views, self.config)

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

    def _add_lines(self, observations: list[Observation], known: dict[int, FusedLine], instant: _Instant) -> None:
        """Fuse the lines of one kind: each into the element it belongs to, what is left over becomes new ones."""
        if not observations:
            return
        local = gather(known, instant.low, instant.high)
        options: list[list[Candidate]] = [
            candidates(observation, known, local, instant.low, self.config) if local is not None else []
            for observation in observations
        ]
        matching = _Matching(options, assign([{c.element: c.benefit for c in row} for row in options]))
        leftovers: list[tuple[Observation, Curve]] = []
        merges: list[tuple[int, int]] = []
        for i in matching.order():
            candidate = matching.take(i)
            if candidate is None:
                leftovers.append((observations[i], observations[i].curve))
                continue
            beside_it, twins = matching.others(i, candidate)
            for other in beside_it:
                _note_beside(self.lines, candidate.element, other)
            merges.extend((candidate.element, other) for other in twins)
            pieces = self._fuse_line(candidate, observations[i], instant, matching.first_time(candidate.element))
            leftovers.extend((observations[i], piece) for piece in pieces)
        for observation, piece in leftovers:
            if len(piece) >= 3:
                self._new_line(observation, piece, instant.timestamp)
        for first, second in merges:
            self._merge_lines(first, second)

    def _fuse_line(self, candidate: Candidate, observation: Observation, instant: _Instant, first: bool) -> list[Curve]:
        """Fuse an observation into a line; ``first`` of this frame. Returns what leaves the line sideways."""
        line, curve, match = self.lines[candidate.element], observation.curve, candidate.match
        if not first:
            # the stations have moved since; match again
            match = beside(line.curve, curve, 1.5 * self.config.match_distance, self.config.match_angle)
            if not len(match.station):
                return []
        (probes,) = ((line.first + match.station) % PROBE_SPACING == 0).nonzero()
        if len(probes):
            station, vertex = match.station.take(probes), match.vertex.take(probes)
            self.errors.note(
                candidate.element,
                line.first + station,
                line.curve.points.take(station, axis=0) + match.offset.take(probes, axis=0),
                observation.directions.take(vertex, axis=0),
                curve.information.take(vertex),
                (*instant.car, _number(observation.track)),
            )
        length, number = len(line.curve), line.first
        pieces = fuse(line, curve, match)
        line.evidence.sighted(observation.track, instant.timestamp, not first)
        before = number - line.first
        for grown in (line.curve.points[:before], line.curve.points[before + length :]):
            if len(grown):
                self.index.extend(candidate.element, grown)
        self._dirty.add(candidate.element)
        return pieces

    def _new_line(self, observation: Observation, curve: Curve, timestamp: int) -> None:
        evidence = Evidence(timestamp, timestamp, tracks={observation.track: 1})
        self.put_line(self.next_id, FusedLine(observation.kind, curve.copy(), evidence))
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
        pieces = fuse(base, other.curve, match)
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
                self.put_line(self.next_id, FusedLine(other.kind, piece.copy(), evidence))
                self.next_id += 1

    def _add_rings(
        self, observations: list[Observation], near: list[int], frame_map: FrameMap, visible: shapely.Geometry | None
    ) -> None:
        cell = self.config.ring_cell
        rooms = [room_of(observation.points, cell) for observation in observations]
        sightings: list[RingSighting] = []
        options: list[dict[int, float]] = []
        corners = np.array([self.rings[i].corner for i in near], dtype=np.int64).reshape(-1, 2)
        stops = np.array([self.rings[i].stop for i in near], dtype=np.int64).reshape(-1, 2)
        for observation, (low, high) in zip(observations, rooms, strict=True):
            rows = np.flatnonzero(((corners < high) & (stops > low)).all(axis=1))
            around = [near[row] for row in rows.tolist()]
            wide_low = np.vstack([corners[rows], low]).min(axis=0)
            wide_high = np.vstack([stops[rows], high]).max(axis=0)
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
            grows = bool((room[0] < ring.corner).any() or (room[1] > ring.stop).any())
            fuse_ring(ring, sighting.crop(*room), frame_map.timestamp)
            for other in row:
                if other != element and other not in chosen and other in self.rings:
                    grows |= self._merge_rings(element, other)
            if grows:
                self._file_ring(element)
            self._dirty.add(element)

    def _merge_rings(self, keep: int, drop: int) -> bool:
        """Make one crossing of two that cover much the same ground; returns whether they do."""
        first, second = self.rings[keep], self.rings[drop]
        low, high = np.maximum(first.corner, second.corner), np.minimum(first.stop, second.stop)
        if (high <= low).any():
            return False
        one, two = first.level(first.window(low, high)) > 0, second.level(second.window(low, high)) > 0
        if np.count_nonzero(one & two) < self.config.ring_overlap * np.count_nonzero(one | two):
            return False
        merge_rings(first, self.rings.pop(drop))
        self.index.remove(drop)
        self._dirty.add(drop)
        return True

    def _file_ring(self, element: int) -> None:
        ring = self.rings[element]
        corners = np.array([ring.corner, ring.stop, [ring.corner[0], ring.stop[1]], [ring.stop[0], ring.corner[1]]])
        self.index.put(element, np.vstack([corners, corners.mean(axis=0)]) * self.config.ring_cell)
        self._dirty.add(element)


@dataclass(frozen=True)
class _Instant:
    """When and where a frame was taken: nanoseconds, the car's position and the box that was looked at, metres."""

    timestamp: int
    car: tuple[float, float]
    low: Float
    high: Float


class _Matching:
    """Which line of the map each observation of a frame goes to, and which stretches of it are taken by then."""

    def __init__(self, options: list[list[Candidate]], chosen: list[int | None]) -> None:
        self.options = options
        self.chosen = chosen
        self.taken: dict[int, set[int]] = {}
        self.touched: set[int] = set()

    def order(self) -> list[int]:
        """Return the observations, those that have an element of their own first."""
        return sorted(range(len(self.options)), key=lambda i: self.chosen[i] is None)

    def take(self, i: int) -> Candidate | None:
        """Return where an observation goes: its own element, or else the first that is free there."""
        options = self.options[i]
        own = [c for c in options if c.element == self.chosen[i]] or [c for c in options if self.free(c)][:1]
        return own[0] if own else None

    def others(self, i: int, candidate: Candidate) -> tuple[list[int], list[int]]:
        """Return the other elements that the observation lies beside: those that the frame shows, too, and the rest.

        The candidate's stretch counts as taken from then on.
        """
        shown: list[int] = []
        twins: list[int] = []
        for other in self.options[i]:
            if other.element != candidate.element:
                seen_too = other.element in self.chosen and not self.free(other)
                (shown if seen_too else twins).append(other.element)
        self.taken.setdefault(candidate.element, set()).update(candidate.match.station.tolist())
        return shown, twins

    def free(self, candidate: Candidate) -> bool:
        """Whether little of a candidate's stretch is taken."""
        stations = self.taken.get(candidate.element)
        if stations is None:
            return True
        return len(stations.intersection(candidate.match.station.tolist())) < 0.3 * candidate.overlap

    def first_time(self, element: int) -> bool:
        """Whether nothing was fused into an element before; from then on something was."""
        first = element not in self.touched
        self.touched.add(element)
        return first


def _number(track: Track) -> float:
    """Return one number for a track of a log."""
    return float(track[1] + (track[0] << 40))


def _note_beside(lines: dict[int, FusedLine], first: int, second: int) -> None:
    for one, other in ((first, second), (second, first)):
        counts = lines[one].evidence.beside
        counts[other] = counts.get(other, 0) + 1
