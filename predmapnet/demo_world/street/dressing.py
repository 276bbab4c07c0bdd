"""From a vector map to a street: everything that a map does not tell is made up here, deterministically."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import shapely
from shapely import Polygon

from mapfusion.arrays import Float
from predmapnet.demo_world.street.clutter import draw_clutter
from predmapnet.demo_world.street.manner import Manner
from predmapnet.demo_world.street.solid_list import SolidList
from predmapnet.demo_world.street.traffic import Parking, add_moving_traffic, ego_corridor, footprint
from predmapnet.demo_world.world import Clutter, Look, Surface, Trajectory, VectorMap, World

SIGHT = 110.0
"""Metres from the trajectory within which things are put up."""


def _polygons(geometry: shapely.Geometry) -> list[Polygon]:
    return [part for part in shapely.get_parts(geometry) if isinstance(part, Polygon) and part.area > 0.05]


def _stations(geometry: shapely.Geometry, spacing: float, generator: np.random.Generator) -> tuple[Float, Float]:
    """Points along the outlines of a geometry with the direction out of it, ``(n, 2)`` each; gaps vary by a half."""
    spots: list[Float] = []
    outward: list[Float] = []
    for polygon in _polygons(geometry):
        oriented = shapely.geometry.polygon.orient(polygon)
        for ring in [oriented.exterior, *oriented.interiors]:
            line = shapely.LineString(ring.coords)
            steps = generator.uniform(0.5, 1.5, int(2 * line.length / spacing) + 2) * spacing
            along = np.cumsum(steps)
            along = along[along < line.length - 1.0]
            if not len(along):
                continue
            here = shapely.get_coordinates(shapely.line_interpolate_point(line, along))
            step = shapely.get_coordinates(shapely.line_interpolate_point(line, along + 0.8)) - here
            step /= np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-9)
            spots.append(here)
            # Rings run with the surface on their left, so outside lies on the right.
            outward.append(np.stack([step[:, 1], -step[:, 0]], axis=1))
    if not spots:
        return np.zeros((0, 2)), np.zeros((0, 2))
    return np.concatenate(spots), np.concatenate(outward)


def _surfaces(
    vector_map: VectorMap, road: shapely.Geometry, sight: shapely.Geometry, alike: bool, generator: np.random.Generator
) -> tuple[list[Surface], shapely.Geometry]:
    """Ground materials from bottom to top, and the sidewalks among them, which may be made as the road is."""
    surfaces: list[Surface] = []
    everything = sight.buffer(220).envelope
    base = ["grass", "grass", "soil", "concrete"][int(generator.integers(4))]
    surfaces += [Surface(part, base) for part in _polygons(everything)]
    for _ in range(24):
        low_x, low_y, high_x, high_y = sight.bounds
        spot = shapely.Point(generator.uniform(low_x, high_x), generator.uniform(low_y, high_y))
        patch = spot.buffer(generator.uniform(8, 30), quad_segs=2)
        surfaces.append(
            Surface(patch, ["grass", "soil", "gravel", "concrete", "asphalt_old"][int(generator.integers(5))])
        )
    if vector_map.walkways:
        walkways = shapely.union_all([shapely.make_valid(walkway) for walkway in vector_map.walkways])
    else:
        # Stretches of sidewalk along the kerb, interrupted by verges.
        ring = road.buffer(generator.uniform(1.8, 3.2), join_style="round").difference(road)
        spots, _ = _stations(road, 45.0, generator)
        verges = [shapely.Point(spot).buffer(generator.uniform(8, 26)) for spot in spots if generator.uniform() < 0.4]
        walkways = ring.difference(shapely.union_all(verges)) if verges else ring
    material = ["sidewalk", "sidewalk", "paving", "brick"][int(generator.integers(4))]
    tone = ["asphalt", "asphalt", "asphalt_old", "asphalt_new"][int(generator.integers(4))]
    surfaces += [Surface(part, tone if alike else material) for part in _polygons(walkways)]
    # Islands and medians have a filling of their own.
    filling = ["grass", "paving", "concrete"][int(generator.integers(3))]
    for polygon in _polygons(road):
        for hole in polygon.interiors:
            if Polygon(hole).area < 1500:
                surfaces.append(Surface(Polygon(hole).difference(walkways), filling))
        surfaces.append(Surface(polygon, tone))
    for segment in vector_map.road_segments:
        if generator.uniform() < 0.22:
            surfaces.append(Surface(segment, ["asphalt", "asphalt_old", "asphalt_new"][int(generator.integers(3))]))
    surfaces += [Surface(bay, "asphalt_old") for bay in vector_map.parking if generator.uniform() < 0.5]
    return surfaces, walkways


def _put_up_buildings(
    solids: SolidList, road: shapely.Geometry, sight: shapely.Geometry, generator: np.random.Generator
) -> shapely.Geometry:
    """Rows of buildings that face the road; returns the ground that they take."""
    clear = road.buffer(4.2)
    shapely.prepare(clear)
    setback, density = generator.uniform(5.5, 11.0), generator.uniform(0.55, 0.95)
    tall = generator.uniform(6, 20)
    spots, outward = _stations(road.buffer(setback), 15.0, generator)
    taken: list[Polygon] = []
    tree = shapely.STRtree([])
    for spot, out in zip(spots, outward, strict=True):
        if generator.uniform() > density or not sight.contains(shapely.Point(spot)):
            continue
        size = np.array(
            [generator.uniform(9, 24), generator.uniform(8, 16), max(3.4, tall * np.exp(generator.normal(0, 0.4)))]
        )
        yaw = float(np.arctan2(out[1], out[0]) + np.pi / 2)
        for shrink in (1.0, 0.6):
            small = size * [shrink, shrink, 1.0]
            centre = spot + out * small[1] / 2
            outline = footprint(centre, yaw, small)
            if clear.intersects(outline) or len(tree.query(outline, predicate="intersects")):
                continue
            taken.append(outline)
            tree = shapely.STRtree(taken)
            solids.building(centre, small, yaw, generator)
            break
    return shapely.union_all(taken) if taken else Polygon()


def _put_up_furniture(
    solids: SolidList,
    road: shapely.Geometry,
    sight: shapely.Geometry,
    taken: shapely.Geometry,
    generator: np.random.Generator,
) -> None:
    """Trees, bushes, lamps, signs, poles and people beside the road."""
    leafy = generator.uniform(7.0, 26.0)
    plan = [
        ("tree", generator.uniform(1.0, 1.8), leafy),
        ("tree", generator.uniform(4.5, 8.0), 20.0),
        ("lamp", 0.7, 28.0),
        ("sign", 0.6, 32.0),
        ("pole", 0.5, 22.0),
        ("bush", generator.uniform(2.5, 5.0), 12.0),
        ("person", 1.2, 30.0),
    ]
    shapely.prepare(taken)
    shapely.prepare(road)
    for kind, aside, spacing in plan:
        spots, outward = _stations(road.buffer(aside, join_style="round"), spacing, generator)
        inside = shapely.contains_xy(sight, spots) if len(spots) else np.zeros(0, dtype=bool)
        free = ~shapely.intersects_xy(taken, spots) & ~shapely.intersects_xy(road, spots) if len(spots) else inside
        for spot, out in zip(spots[inside & free], outward[inside & free], strict=True):
            if kind == "tree":
                solids.tree(spot, generator)
            elif kind == "lamp":
                solids.street_lamp(spot, -out)
            elif kind == "sign":
                along = np.arctan2(out[0], -out[1])
                solids.sign(spot, float(along + np.pi * generator.integers(2)), generator)
            elif kind == "pole":
                height = float(generator.choice([0.9, 0.9, 3.2, 8.0]))
                solids.stand("cylinder", spot, (0.14, 0.14, height), 0.0, (0.20, 0.19, 0.17))
            elif kind == "bush":
                solids.bush(spot, generator)
            else:
                solids.pedestrian(spot + out * generator.uniform(-0.4, 0.8), generator)


def dress(
    vector_map: VectorMap, trajectory: Trajectory, look: Look, seed: int, name: str, cluttered: bool = False
) -> World:
    """Make up everything that a vector map does not hold; the same seed gives the same world.

    Args:
        vector_map: what is true about the road; lanes, walkways and parking bays may be missing (real maps).
        trajectory: things are put up within sight of it, and nothing stands or drives in its way.
        look: light and weather.
        seed: of all that is drawn by chance.
        name: of the scene.
        cluttered: put on the ground what looks like elements of the map and is none, and pave and park as one likes.
    """
    generator = np.random.default_rng([seed, 31])
    positions = trajectory.ego_to_global[:, :2, 3]
    drive_line = shapely.LineString(np.vstack([positions, positions[-1] + 0.1]))
    sight = drive_line.buffer(SIGHT)
    shapely.prepare(sight)
    united = shapely.union_all([segment.buffer(0.02, join_style="mitre") for segment in vector_map.road_segments])
    road = united.buffer(-0.02, join_style="mitre").intersection(sight.buffer(200))
    manner = Manner.draw(seed) if cluttered else Manner()
    surfaces, _ = _surfaces(vector_map, road, sight, manner.paved_alike, generator)

    solids = SolidList()
    buildings = _put_up_buildings(solids, road, sight, generator)
    _put_up_furniture(solids, road.intersection(sight.buffer(20)), sight, buildings, generator)
    crossings = [crossing.polygon.buffer(2.0) for crossing in vector_map.crossings]
    stops = [polygon.buffer(1.0) for polygon in vector_map.stop_lines]
    forbidden = shapely.union_all([*crossings, *stops, ego_corridor(trajectory, width=4.3)])
    parking = Parking(solids, forbidden, generator)
    busy = generator.uniform(0.35, 0.9)
    parking.in_bays(vector_map.parking, manner.parked or busy, manner.gaps)
    parking.along_kerbs(road, sight, 0.34 * busy)
    add_moving_traffic(solids, vector_map, road, trajectory, seed)
    clutter = draw_clutter(vector_map, road, trajectory, seed) if cluttered else Clutter()
    clutter = replace(clutter, kerbs=manner.kerbs)
    return World(
        name,
        seed,
        look,
        vector_map,
        trajectory,
        tuple(surfaces),
        solids.solids(),
        clutter,
        kerb_height=manner.kerb_height,
    )
