"""Vector maps and their integration: tracked polylines and poses in, one global map out. No torch."""

from mapfusion.elements import ElementKind, FrameMap, GlobalMap, MapElement, RegionOfInterest

__all__ = ["ElementKind", "FrameMap", "GlobalMap", "MapElement", "RegionOfInterest"]
