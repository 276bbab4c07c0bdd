"""Map integrator: tracked polylines of single frames in, one global map with evidence out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import shapely

from mapfusion.arrays import Float
from mapfusion.elements import ElementKind, FrameMap, GlobalMap, MapElement
from mapfusion.geometry import rigid_pose_problem
from mapfusion.ground import ground_problem
from mapfusion.integrate.association import (
    MATCH_REACH,
    LineCandidate,
    LineMatching,
    RingCandidates,
    best_assignment,
    ring_candidates,
)
from mapfusion.integrate.config import IntegratorConfig
from mapfusion.integrate.evidence import Evidence, Track
from mapfusion.integrate.extraction import line_elements, ring_elements
from mapfusion.integrate.fused_line import FusedLine, beside, fuse
from mapfusion.integrate.fused_ring import FusedRing, absorb_ring, fuse_ring, new_ring, same_ground
from mapfusion.integrate.joined_map import JoinedMap
from mapfusion.integrate.observations import Observation, observe
from mapfusion.integrate.state import IntegratorState, load_state, save_state
from mapfusion.integrate.station_curve import StationCurve
from mapfusion.integrate.tile_index import TileIndex
from mapfusion.integrate.uncertainty import PRIOR_SHARES, PROBE_SPACING, Probe
from mapfusion.integrate.views import clearly_visible

STALE = 0.1
"""Relative change of the learnt error model from which on the uncertainty of the whole map is computed anew."""

BOX_MARGIN = 2.0
"""Elements this far outside the looked-at box are still near a frame, metres."""

SHORTEST_LINE = 3
"""Leftovers of an observation with fewer vertices start no line."""

SIDE_BY_SIDE = 0.25
"""Share of frames that show two lines side by side from which on they are not one line."""


@dataclass(frozen=True)
class _PlacedFrame:
    """Frame with the ground around it.

    Attributes:
        frame_map: the frame.
        visible: ground that could be seen, clear of its rim, ego frame; None for all of the ROI.
        car: ``(2,)``, position, metres, global frame.
        low, high: ``(2,)``, box around the ROI, metres, global frame.
    """

    frame_map: FrameMap
    visible: shapely.Geometry | None
    car: Float
    low: Float
    high: Float

    @classmethod
    def of(cls, frame_map: FrameMap) -> _PlacedFrame:
        car = np.array(frame_map.ego_to_global[:2, 3], dtype=np.float64)
        reach = np.abs(frame_map.ego_to_global[:2, :2]) @ (frame_map.roi.size / 2) + BOX_MARGIN
        return cls(frame_map, clearly_visible(frame_map), car, car - reach, car + reach)

    @property
    def timestamp(self) -> int:
        return self.frame_map.timestamp


class MapIntegrator:
    """Fuses the maps of single frames into one global map.

    Frames may come in any order and from several drives. The cost of a frame depends on what lies around the car,
    not on the size of the map.

    Attributes:
        state: all that it knows.

    Example:
        >>> integrator = MapIntegrator()
        >>> len(integrator.map())
        0
    """

    def __init__(self, config: IntegratorConfig | None = None) -> None:
        self._resume(IntegratorState(config or IntegratorConfig()))

    def _resume(self, state: IntegratorState) -> None:
        self.state = state
        self._index = TileIndex()
        self._error_parts = PRIOR_SHARES
        self._changed: set[int] = set()
        self._joined = JoinedMap()
        self._elements: tuple[MapElement, ...] = ()
        for element, line in state.lines.items():
            self.put_line(element, line)
        for element, ring in state.rings.items():
            self.put_ring(element, ring)

    @property
    def config(self) -> IntegratorConfig:
        """Assumptions about the detector and the road."""
        return self.state.config

    @property
    def rejections(self) -> Counter[str]:
        """Number of frames and elements left out, by reason."""
        return self.state.rejections

    @property
    def frames(self) -> int:
        """Number of frames that were fused."""
        return self.state.frames

    def add(self, frame_map: FrameMap, log: str = "") -> None:
        """Fuse the tracked elements of one frame.

        Broken input (poses, points, scores) is counted in :attr:`rejections` and changes nothing else. A frame of
        the same log and timestamp as an earlier one adds no evidence and is left out, too.

        Args:
            frame_map: what the mapper saw.
            log: name of the drive; poses are checked against other frames of the same drive only, and equal track
                ids of two drives are two tracks.
        """
        state, pose = self.state, frame_map.ego_to_global
        problem = (
            rigid_pose_problem(pose)
            or ground_problem(frame_map)
            or state.frame_log.enter(log, frame_map.timestamp, pose[:2, 3], self.config.max_speed)
        )
        if problem is not None:
            state.rejections[problem] += 1
            return
        frame = _PlacedFrame.of(frame_map)
        drive = state.frame_log.drive(log).number
        lines, rings = observe(frame_map, self.config, state.rejections, drive, frame.visible)
        state.frames += 1
        state.views.add(pose, frame_map.roi, frame.visible)
        near = self._index.near(frame.low, frame.high)
        self._changed.update(near)
        self._joined.looked_at(frame.low, frame.high, self.config)
        for kind in (ElementKind.DIVIDER, ElementKind.BOUNDARY):
            known = {i: state.lines[i] for i in near if i in state.lines and state.lines[i].kind is kind}
            self._add_lines([line for line in lines if line.kind is kind], known, frame)
        self._add_rings(rings, {i: state.rings[i] for i in near if i in state.rings}, frame)

    def map(self) -> GlobalMap:
        """Return the map as it stands; only what changed since the last call is computed."""
        if self._changed:
            self._refresh()
        return GlobalMap(self._elements, {"frames": self.frames, "integrator": asdict(self.config)})

    def save(self, path: Path) -> None:
        """Write the state to a ``.npz`` file, to go on later with :meth:`load`; raises OSError."""
        save_state(self.state, path)

    @classmethod
    def load(cls, path: Path) -> MapIntegrator:
        """Return the integrator that :meth:`save` wrote; raises ValueError for other files, OSError."""
        integrator = cls()
        integrator._resume(load_state(path))
        return integrator

    def put_line(self, element: int, line: FusedLine) -> None:
        """File a line under an id of its own."""
        self.state.lines[element] = line
        self._index.put(element, line.curve.points)
        self._changed.add(element)

    def put_ring(self, element: int, ring: FusedRing) -> None:
        """File a crossing under an id of its own, or anew where it has grown."""
        self.state.rings[element] = ring
        (left, low), (right, high) = ring.corner, ring.stop
        corners = np.array([[left, low], [right, high], [left, high], [right, low]])
        self._index.put(element, np.vstack([corners, corners.mean(axis=0)]) * self.config.ring_cell)
        self._changed.add(element)

    def _refresh(self) -> None:
        state, parts = self.state, self.state.errors.parts()
        if np.abs(parts - self._error_parts).sum() > STALE * self._error_parts.sum():
            self._error_parts = parts
            self._changed.update(state.lines, state.rings)
        logs = {drive.number: log for log, drive in state.frame_log.logs.items()}
        for element in self._changed:
            found: list[MapElement] = []
            if element in state.lines:
                found = line_elements(state.lines[element], state.views, self._error_parts, self.config, logs)
            elif element in state.rings:
                found = ring_elements(state.rings[element], state.views, self._error_parts, self.config, logs)
            self._joined.put(element, found)
        self._changed.clear()
        self._elements = self._joined.elements(state.views, self.config)

    def _new_id(self) -> int:
        self.state.next_id += 1
        return self.state.next_id - 1

    def _add_lines(
        self, observations: Sequence[Observation], known: Mapping[int, FusedLine], frame: _PlacedFrame
    ) -> None:
        """Fuse the lines of one kind: each into the element it belongs to, what is left over becomes new ones."""
        if not observations:
            return
        matching = LineMatching(observations, known, frame.low, frame.high, self.config)
        leftovers: list[tuple[Track, StationCurve]] = []
        twins: list[tuple[int, int]] = []
        for number in matching.order():
            observation, chosen = observations[number], matching.choice(number)
            if chosen is None:
                leftovers.append((observation.track, observation.curve))
                continue
            first = matching.untouched(chosen.element)
            shown, same = matching.take(number, chosen)
            self._note_side_by_side(chosen.element, shown)
            twins.extend((chosen.element, other) for other in same)
            leftovers.extend((observation.track, part) for part in self._fuse_line(chosen, observation, frame, first))
        for track, curve in leftovers:
            evidence = Evidence(frame.timestamp, frame.timestamp, tracks={track: 1})
            self._new_line(observations[0].kind, curve, evidence)
        for one, other in twins:
            self._unite_lines(one, other)

    def _note_side_by_side(self, element: int, others: Sequence[int]) -> None:
        for other in others:
            for one, two in ((element, other), (other, element)):
                counts = self.state.lines[one].evidence.beside
                counts[two] = counts.get(two, 0) + 1

    def _fuse_line(
        self, chosen: LineCandidate, observation: Observation, frame: _PlacedFrame, first: bool
    ) -> list[StationCurve]:
        """Fuse an observation into a line; ``first`` of this frame. Returns what leaves the line sideways."""
        line, curve, match = self.state.lines[chosen.element], observation.curve, chosen.match
        if not first:
            # the stations have moved since; match again
            match = beside(line.curve, curve, MATCH_REACH * self.config.match_distance, self.config.match_angle)
            if not len(match.station):
                return []
        (probed,) = ((line.first + match.station) % PROBE_SPACING == 0).nonzero()
        if len(probed):
            station, vertex = match.station.take(probed), match.vertex.take(probed)
            log, track = observation.track
            probe = Probe(
                element=chosen.element,
                stations=line.first + station,
                feet=line.curve.points.take(station, axis=0) + match.offset.take(probed, axis=0),
                directions=observation.directions.take(vertex, axis=0),
                information=curve.information.take(vertex),
                car=frame.car,
                track=track + (log << 40),
            )
            self.state.errors.note(probe)
        length, number = len(line.curve), line.first
        parts = fuse(line, curve, match)
        line.evidence.sighted(observation.track, frame.timestamp, not first)
        before = number - line.first
        for grown in (line.curve.points[:before], line.curve.points[before + length :]):
            if len(grown):
                self._index.extend(chosen.element, grown)
        self._changed.add(chosen.element)
        return parts

    def _new_line(self, kind: ElementKind, curve: StationCurve, evidence: Evidence) -> None:
        if len(curve) >= SHORTEST_LINE:
            self.put_line(self._new_id(), FusedLine(kind, curve.copy(), evidence))

    def _unite_lines(self, first: int, second: int) -> None:
        """Make one line of two, unless single frames have shown both side by side."""
        lines = self.state.lines
        if first == second or first not in lines or second not in lines:
            return
        keep, drop = min(first, second), max(first, second)
        base, other = lines[keep], lines[drop]
        fewer = min(base.evidence.observations, other.evidence.observations)
        if base.evidence.beside.get(drop, 0) > SIDE_BY_SIDE * fewer:
            return
        match = beside(base.curve, other.curve, self.config.match_distance, self.config.match_angle)
        if len(match.station) < 2 or match.distance.mean() > self.config.merge_distance:
            return
        parts = fuse(base, other.curve, match)
        base.evidence.absorb(other.evidence)
        self._changed.update((keep, drop))
        self._index.put(keep, base.curve.points)
        self._index.remove(drop)
        del lines[drop]
        known = other.evidence
        for part in parts:
            evidence = Evidence(known.first_seen, known.last_seen, known.observations, dict(known.tracks))
            self._new_line(other.kind, part, evidence)

    def _add_rings(
        self, observations: Sequence[Observation], known: Mapping[int, FusedRing], frame: _PlacedFrame
    ) -> None:
        """Fuse the rings of a frame: each into the crossing it belongs to, the others become new ones."""
        found = ring_candidates(observations, known, frame.frame_map, frame.visible, self.config)
        chosen = best_assignment([candidates.overlaps for candidates in found])
        for candidates, element in zip(found, chosen, strict=True):
            if element is None:
                sighting = candidates.sighting.crop(candidates.low, candidates.high)
                self.put_ring(self._new_id(), new_ring(sighting, frame.timestamp))
            else:
                twins = [other for other in candidates.overlaps if other not in chosen]
                self._fuse_ring(element, candidates, twins, frame.timestamp)

    def _fuse_ring(self, element: int, candidates: RingCandidates, twins: Sequence[int], timestamp: int) -> None:
        """Fuse an observed ring into a crossing, and the other crossings that it showed to be the same one."""
        ring = self.state.rings[element]
        low, high = np.minimum(candidates.low, ring.corner), np.maximum(candidates.high, ring.stop)
        grows = bool((low < ring.corner).any() or (high > ring.stop).any())
        fuse_ring(ring, candidates.sighting.crop(low, high), timestamp)
        for other in twins:
            grows |= self._unite_rings(element, other)
        if grows:
            self.put_ring(element, ring)
        self._changed.add(element)

    def _unite_rings(self, keep: int, drop: int) -> bool:
        """Make one crossing of two that cover much the same ground; returns whether they do."""
        rings = self.state.rings
        if drop not in rings or not same_ground(rings[keep], rings[drop], self.config.ring_overlap):
            return False
        absorb_ring(rings[keep], rings.pop(drop))
        self._index.remove(drop)
        self._changed.add(drop)
        return True
