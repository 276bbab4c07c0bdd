"""Where roads meet: the paved outline with rounded corners, and how far each junction reaches along its arms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from predmapnet.demo_world.town_v1.roads import Road
from predmapnet.demo_world.town_v1.town_plan import TownPlan

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Arm:
    """One end of a stretch of road, at a junction or at the edge of the town.

    Distances are metres along the road, measured from the node.

    Attributes:
        edge: index of the stretch.
        side: +1 at its start, where the road leaves the node along its stations; -1 at its end.
        node: index of the node, -1 at the edge of the town.
        clear: where the junction ends and the road has its own width.
        crossing: from where to where pedestrians cross; both equal ``clear`` where they do not.
        stop: where arriving cars stop.
    """

    edge: int
    side: int
    node: int
    clear: float
    crossing: tuple[float, float]
    stop: float


def pave(plan: TownPlan, corner_radius: float) -> shapely.Geometry:
    """Outline of all roads and junctions, its inner corners rounded with ``corner_radius`` metres."""
    strips = []
    for edge in plan.edges:
        road = plan.roads[edge.road]
        half = road.section.half_width
        strip = road.strip(edge.start, edge.end, -half, half)
        for side, node in ((1, edge.nodes[0]), (-1, edge.nodes[1])):
            if node >= 0 and _ends_here(plan, edge.road, node):
                strip = strip.difference(_far_side(plan, edge.road, node, road, side))
        strips.append(strip)
    circles = [shapely.Point(node.position).buffer(node.outer_radius, 24) for node in plan.nodes if node.is_roundabout]
    joined = shapely.union_all(strips + circles)
    return joined.buffer(corner_radius, quad_segs=12).buffer(-corner_radius, quad_segs=12).simplify(0.02)


def has_splitter(plan: TownPlan, road: Road, node: int) -> bool:
    """Whether an island divides the directions where a road without a median meets a roundabout."""
    return node >= 0 and plan.nodes[node].is_roundabout and road.section.median == 0.0


def _ends_here(plan: TownPlan, road: int, node: int) -> bool:
    return sum(plan.edges[edge].road == road for edge, _ in plan.arms(node)) == 1


def _far_side(plan: TownPlan, road: int, node: int, ending: Road, side: int) -> shapely.Polygon:
    """The half of the through road that a road ending at ``node`` must not reach over."""
    through_arms = [(edge, arm_side) for edge, arm_side in plan.arms(node) if plan.edges[edge].road != road]
    edge, arm_side = through_arms[0]
    through = plan.roads[plan.edges[edge].road]
    station = plan.edges[edge].start if arm_side == 1 else plan.edges[edge].end
    position = plan.nodes[node].position
    inward = _direction_near(ending, position) * side
    along = through.direction(np.array([station]))[0]
    to_left = along[0] * inward[1] - along[1] * inward[0]
    sides = (-40.0, 0.0) if to_left > 0 else (0.0, 40.0)
    return through.strip(max(station - 35.0, 0.0), min(station + 35.0, through.length), *sides)


def _direction_near(road: Road, position: Float) -> Float:
    """Unit tangent of a road at its sample nearest to a position."""
    nearest = int(np.argmin(np.linalg.norm(road.points - position, axis=1)))
    tangent: Float = road.tangents[nearest]
    return tangent


def clear_distance(plan: TownPlan, pavement: shapely.Geometry, edge_index: int, side: int) -> float:
    """Distance from the node at which the pavement first has the width of the road alone, metres."""
    edge = plan.edges[edge_index]
    road = plan.roads[edge.road]
    reach = min(45.0, 0.5 * (edge.end - edge.start))
    distances = np.arange(2.0, reach, 0.75)
    stations = (edge.start if side == 1 else edge.end) + side * distances
    half = road.section.half_width
    across = np.stack([road.locate(stations, -half - 1.5), road.locate(stations, half + 1.5)], axis=1)
    around = shapely.clip_by_rect(pavement, *(across.min(axis=(0, 1)) - 1.0), *(across.max(axis=(0, 1)) + 1.0))
    widths = shapely.length(shapely.intersection(shapely.linestrings(across), around))
    wide = np.flatnonzero(widths > 2 * half + 0.12)
    return float(distances[wide[-1]] + 0.75) if len(wide) else 2.0
