"""Ground truth of the demo world, straight from its vector maps."""

from __future__ import annotations

from shapely import LineString

from predmapnet.datasets.ground_truth.nuscenes import NuScenesGroundTruth
from predmapnet.demo_world.world import VectorMap


def truth_from_vector_map(vector_map: VectorMap) -> NuScenesGroundTruth:
    """Return the ground truth that a map has once it is written as a nuScenes data set, without files."""
    by_direction = sorted(vector_map.dividers, key=lambda divider: not divider.opposite)
    return NuScenesGroundTruth.from_layers(
        dividers=[LineString(divider.points) for divider in by_direction],
        crossings=[crossing.polygon for crossing in vector_map.crossings],
        road_segments=list(vector_map.road_segments),
        lanes=list(vector_map.lanes),
    )
