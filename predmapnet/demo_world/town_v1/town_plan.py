"""The plan of a town: roads laid over a bent and sheared grid, some blocks merged, junctions where they meet."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from predmapnet.demo_world.town_v1.roads import CrossSection, Road, road_through
from predmapnet.demo_world.world import LineStyle

Float = NDArray[np.float64]

TOWN_CENTRE = np.array([400.0, 400.0])
"""Where every town lies in the global frame, metres: all coordinates stay positive."""


@dataclass(frozen=True)
class Node:
    """A place where roads meet.

    Attributes:
        position: ``(2,) float64``, metres.
        island_radius, outer_radius: metres, of a roundabout; 0 for a plain junction.
    """

    position: Float
    island_radius: float = 0.0
    outer_radius: float = 0.0

    @property
    def is_roundabout(self) -> bool:
        """Whether traffic circles an island here."""
        return self.outer_radius > 0.0


@dataclass(frozen=True)
class Edge:
    """A stretch of road between two nodes, or between a node and the edge of the town.

    Attributes:
        road: index of its road.
        start, end: stations on the road, metres.
        nodes: index of the node at the start and at the end; -1 at the edge of the town.
    """

    road: int
    start: float
    end: float
    nodes: tuple[int, int]

    @property
    def leaves_town(self) -> bool:
        """Whether the road ends in the open at one side."""
        return -1 in self.nodes


@dataclass(frozen=True)
class TownPlan:
    """Roads, nodes and edges, before any kerb or paint."""

    roads: tuple[Road, ...]
    nodes: tuple[Node, ...]
    edges: tuple[Edge, ...]

    def arms(self, node: int) -> list[tuple[int, int]]:
        """The edges at a node as (edge index, side), side +1 where the road leaves the node along its stations."""
        return [
            (index, 1 if side == 0 else -1)
            for index, edge in enumerate(self.edges)
            for side in range(2)
            if edge.nodes[side] == node
        ]


def plan_town(random: Generator) -> TownPlan:
    """Draw the plan of a town of roughly 300 x 300 m. Every node joins three or four arms."""
    rows, columns = [(3, 3), (3, 3), (2, 3), (3, 2)][random.integers(4)]
    knots = _bent_grid(random, rows, columns)
    centre_colour = "yellow" if random.random() < 0.5 else "white"
    roads: list[Road] = []
    stretches: list[Edge] = []
    for row in range(rows):
        nodes = [row * columns + column for column in range(columns)]
        _lay_road(random, knots[row + 1, :], nodes, centre_colour, roads, stretches)
    for column in range(columns):
        nodes = [row * columns + column for row in range(rows)]
        _lay_road(random, knots[:, column + 1], nodes, centre_colour, roads, stretches)
    positions = knots[1:-1, 1:-1].reshape(-1, 2)
    plan = TownPlan(tuple(roads), tuple(Node(position) for position in positions), tuple(stretches))
    return _place_roundabout(random, _merge_blocks(random, plan))


def _bent_grid(random: Generator, rows: int, columns: int) -> Float:
    """Knots ``(rows + 2, columns + 2, 2)``: jittered, sheared and turned; the rim is where roads leave the town."""

    def ticks(count: int) -> Float:
        gaps = random.uniform(74.0, 92.0, count - 1) if count == 3 else random.uniform(88.0, 112.0, count - 1)
        inner = np.concatenate([[0.0], np.cumsum(gaps)])
        outer: Float = np.concatenate([[-65.0], inner, [inner[-1] + 65.0]]) - inner[-1] / 2
        return outer

    x, y = np.meshgrid(ticks(columns), ticks(rows))
    knots = np.stack([x, y], axis=-1)
    knots += random.uniform(-11.0, 11.0, knots.shape)
    shear = np.tan(np.radians(random.uniform(-22.0, 22.0)))
    angle = random.uniform(-np.pi, np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    bent: Float = knots @ (turn @ np.array([[1.0, shear], [0.0, 1.0]])).T + TOWN_CENTRE
    return bent


def _lay_road(
    random: Generator, knots: Float, nodes: list[int], centre_colour: str, roads: list[Road], edges: list[Edge]
) -> None:
    """Append one road through a row of knots, and its stretches. Between knots it bends once more."""
    middles = (knots[:-1] + knots[1:]) / 2 + random.uniform(-5.0, 5.0, knots[1:].shape)
    line = np.empty((2 * len(knots) - 1, 2))
    line[0::2], line[1::2] = knots, middles
    road, stations = road_through(line, _draw_section(random, centre_colour))
    ends = [-1, *nodes, -1]
    for index in range(len(ends) - 1):
        pair = (ends[index], ends[index + 1])
        edges.append(Edge(len(roads), float(stations[2 * index]), float(stations[2 * index + 2]), pair))
    roads.append(road)


def _draw_section(random: Generator, centre_colour: str) -> CrossSection:
    lanes = int(random.choice([1, 2, 3], p=[0.40, 0.42, 0.18]))
    has_median = random.random() < (0.08, 0.30, 0.55)[lanes - 1]
    centre_styles = [
        LineStyle.DOUBLE_SOLID,
        LineStyle.SOLID,
        LineStyle.DASHED,
        LineStyle.SOLID_DASHED,
        LineStyle.UNPAINTED,
    ]
    lane_styles = [LineStyle.DASHED, LineStyle.SOLID, LineStyle.UNPAINTED]
    weights = [0.25, 0.25, 0.33, 0.10, 0.07] if lanes == 1 else [0.48, 0.37, 0.05, 0.10, 0.0]
    return CrossSection(
        lanes=lanes,
        lane_width=float(random.uniform(3.0, 3.6)),
        median=float(random.uniform(1.8, 4.0)) if has_median else 0.0,
        shoulder=float(random.uniform(0.25, 0.6)),
        centre_style=centre_styles[random.choice(5, p=weights)],
        lane_style=lane_styles[random.choice(3, p=[0.84, 0.13, 0.03])],
        centre_colour=centre_colour,
    )


def _merge_blocks(random: Generator, plan: TownPlan) -> TownPlan:
    """Drop some stretches; a node loses at most one arm, so three remain, and the town stays in one piece."""
    for candidate in [plan.edges[index] for index in random.permutation(len(plan.edges))]:
        ends = [node for node in candidate.nodes if node >= 0]
        if random.random() < 0.18 and all(len(plan.arms(node)) == 4 for node in ends):
            thinner = replace(plan, edges=tuple(edge for edge in plan.edges if edge is not candidate))
            plan = thinner if _is_connected(thinner) else plan
    return plan


def _is_connected(plan: TownPlan) -> bool:
    reached, frontier = {0}, [0]
    while frontier:
        node = frontier.pop()
        neighbours = {end for edge, _ in plan.arms(node) for end in plan.edges[edge].nodes if end >= 0} - reached
        reached |= neighbours
        frontier += neighbours
    return len(reached) == len(plan.nodes)


def _place_roundabout(random: Generator, plan: TownPlan) -> TownPlan:
    """Turn one node of about every third town into a roundabout, where the roads are narrow enough."""
    if random.random() > 0.4:
        return plan
    for index in random.permutation(len(plan.nodes)):
        sections = [plan.roads[plan.edges[edge].road].section for edge, _ in plan.arms(int(index))]
        if max(section.half_width for section in sections) < 9.0:
            island = float(random.uniform(6.0, 9.5))
            ring = 6.2 if max(section.lanes for section in sections) == 1 else 8.5
            nodes = list(plan.nodes)
            nodes[index] = replace(nodes[index], island_radius=island, outer_radius=island + ring)
            return replace(plan, nodes=tuple(nodes))
    return plan
