"""Vector maps and their integration: tracked polylines and poses in, one global map out. No torch."""

from mapfusion.elements import ElementKind, FrameMap, GlobalMap, MapElement, RegionOfInterest
from mapfusion.ground import CameraSector, visible_ground
from mapfusion.integrate.config import IntegratorConfig
from mapfusion.integrate.integrator import MapIntegrator

__all__ = [
    "CameraSector",
    "ElementKind",
    "FrameMap",
    "GlobalMap",
    "IntegratorConfig",
    "MapElement",
    "MapIntegrator",
    "RegionOfInterest",
    "visible_ground",
]
