import numpy as np
import pytest
import shapely
from shapely import Polygon, box

from predmapnet.demo_world.world import Crossing, CrossingStyle, Divider, LineStyle, Trajectory, VectorMap


@pytest.fixture(scope="module")
def street():
    """Two roads that cross, an island, crossings of all kinds; no walkways and no lanes, like a real map."""
    road = shapely.union_all([box(-100, -7, 100, 7), box(-7, -90, 7, 90)])
    road = road.difference(Polygon([(15, -0.8), (28, -0.8), (28, 0.8), (15, 0.8)]))
    dividers = (
        Divider(np.array([[30.0, 0.0], [98.0, 0.0]]), LineStyle.DOUBLE_SOLID, "yellow", True),
        Divider(np.array([[-98.0, 0.0], [-14.0, 0.0]]), LineStyle.SOLID_DASHED, "yellow", True),
        Divider(np.array([[-98.0, -3.5], [-14.0, -3.5]]), LineStyle.DASHED),
        Divider(np.array([[0.0, 12.0], [0.0, 88.0]]), LineStyle.SOLID),
    )
    crossings = (
        Crossing(box(9, -7, 12.5, 7), CrossingStyle.ZEBRA, np.pi / 2),
        Crossing(box(-12.5, -7, -9, 7), CrossingStyle.LADDER, np.pi / 2),
        Crossing(Polygon([(-7, 9), (7, 10.5), (7, 13.5), (-7, 12)]), CrossingStyle.LINES, float(np.arctan2(1.5, 14))),
    )
    poses = np.tile(np.eye(4), (12, 1, 1))
    poses[:, 0, 3], poses[:, 1, 3] = -45 + 3.5 * np.arange(12), -1.8
    vector_map = VectorMap((road,), (), crossings, dividers, (), (box(-60, 4.9, -30, 7),))
    return vector_map, Trajectory(np.arange(12) * 500_000_000, poses)
