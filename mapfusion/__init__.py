"""Vector maps and their integration: tracked polylines and poses in, one global map out. No torch."""

from mapfusion.config import IntegratorConfig
from mapfusion.elements import ElementKind, FrameMap, GlobalMap, MapElement, RegionOfInterest
from mapfusion.integrator import MapIntegrator

__all__ = [
    "ElementKind",
    "FrameMap",
    "GlobalMap",
    "IntegratorConfig",
    "MapElement",
    "MapIntegrator",
    "RegionOfInterest",
]
