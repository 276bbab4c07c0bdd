"""PredMapNet: online vectorised HD-map construction with future and historical reasoning (WACV 2026).

The names below are what a script needs. They are imported when they are first used, so that ``import predmapnet`` is
fast and loads no torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mapfusion.elements import ElementKind, FrameMap, GlobalMap, MapElement, RegionOfInterest
    from mapfusion.formats.by_suffix import read_map, write_map
    from mapfusion.ground import observed_rings, seen_along
    from mapfusion.integrate.integrator import MapIntegrator
    from predmapnet.errors import UserError
    from predmapnet.machine import NetworkOptions, Precision
    from predmapnet.mapper import Mapper
    from predmapnet.mapping import NETWORK_ERRORS, map_scene
    from predmapnet.presets import PRESETS, preset
    from predmapnet.scenes import Camera, Frame
    from predmapnet.sources import open_source

__version__ = "0.1.0"

__all__ = [
    "NETWORK_ERRORS",
    "PRESETS",
    "Camera",
    "ElementKind",
    "Frame",
    "FrameMap",
    "GlobalMap",
    "MapElement",
    "MapIntegrator",
    "Mapper",
    "NetworkOptions",
    "Precision",
    "RegionOfInterest",
    "UserError",
    "map_scene",
    "observed_rings",
    "open_source",
    "preset",
    "read_map",
    "seen_along",
    "write_map",
]

_MODULES = {
    "mapfusion.elements": ("ElementKind", "FrameMap", "GlobalMap", "MapElement", "RegionOfInterest"),
    "mapfusion.formats.by_suffix": ("read_map", "write_map"),
    "mapfusion.ground": ("observed_rings", "seen_along"),
    "mapfusion.integrate.integrator": ("MapIntegrator",),
    "predmapnet.errors": ("UserError",),
    "predmapnet.machine": ("NetworkOptions", "Precision"),
    "predmapnet.mapper": ("Mapper",),
    "predmapnet.mapping": ("NETWORK_ERRORS", "map_scene"),
    "predmapnet.presets": ("PRESETS", "preset"),
    "predmapnet.scenes": ("Camera", "Frame"),
    "predmapnet.sources": ("open_source",),
}


def __getattr__(name: str) -> Any:
    for module, names in _MODULES.items():
        if name in names:
            return getattr(import_module(module), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
