"""Vector maps and their fusion: tracked polylines and poses in, one global map out. No torch.

- :class:`MapIntegrator` fuses the :class:`FrameMap` of single frames into a :class:`GlobalMap`.
- :func:`merge_maps` and :func:`merge_files` make one map of the maps of many drives; :func:`diff_maps` says what
  changed between two.
- :func:`write_map` and :func:`read_map` know GeoJSON, GeoPackage, FlatGeobuf, Lanelet2, OpenDRIVE, nuScenes and
  Argoverse 2.
- :func:`correct_poses` takes out what the poses of single frames are off.
- :func:`visible_ground` says what ground cameras see, :func:`seen_along` what ground a drive looked at.
"""

from mapfusion.diff import DiffConfig, diff_maps
from mapfusion.elements import ElementKind, FrameMap, GlobalMap, MapElement, RegionOfInterest
from mapfusion.formats.by_suffix import read_map, write_map
from mapfusion.ground import CameraSector, seen_along, visible_ground
from mapfusion.integrate.config import IntegratorConfig
from mapfusion.integrate.integrator import MapIntegrator
from mapfusion.merge.config import MergeConfig
from mapfusion.merge.merge import merge_files, merge_maps
from mapfusion.pose_correction import PoseErrors, correct_poses

__all__ = [
    "CameraSector",
    "DiffConfig",
    "ElementKind",
    "FrameMap",
    "GlobalMap",
    "IntegratorConfig",
    "MapElement",
    "MapIntegrator",
    "MergeConfig",
    "PoseErrors",
    "RegionOfInterest",
    "correct_poses",
    "diff_maps",
    "merge_files",
    "merge_maps",
    "read_map",
    "seen_along",
    "visible_ground",
    "write_map",
]
