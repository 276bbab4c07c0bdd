"""The layout of recordings: cameras and the whole map above; the car, its memory and the plots below."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import rerun.blueprint as rrb

from mapfusion.arrays import Float
from mapfusion.colours import BACKGROUND
from predmapnet.scenes import Rig

CAMERA_ORDER = (
    "CAM_FRONT_LEFT",
    "CAM_FRONT",
    "CAM_FRONT_RIGHT",
    "CAM_BACK_LEFT",
    "CAM_BACK",
    "CAM_BACK_RIGHT",
    "ring_side_left",
    "ring_front_left",
    "ring_front_center",
    "ring_front_right",
    "ring_side_right",
    "ring_rear_left",
    "ring_rear_right",
)
"""Order of the camera views: as one looks around, front row first."""

EYE_OVER_HEIGHT = 1.0
"""Height of the eye over a map, as a share of the map's height on the screen."""

PANEL_ASPECT = 1.3
"""Width of the panel of a whole map, as a share of its height."""

EARTH_PANEL = 500.0
"""Points of the screen that a map on Earth fills at first sight."""
METRES_PER_POINT = 110_000.0
"""Of a web map at zoom 0, at 45 degrees of latitude; each step of the zoom halves them."""
CLOSEST = 19.0
"""Zoom to which tiles of OpenStreetMap are drawn."""

TRUTH, GROWING_MAP, WHOLE_MAP = "world/ground_truth", "world/map", "world/whole_map"


@dataclass(frozen=True)
class Extent:
    """Extent of a map or drive, metres of the recording.

    Attributes:
        centre: x and y.
        width, height: along x and y.
    """

    centre: tuple[float, float]
    width: float
    height: float

    @classmethod
    def of(cls, points: Float, margin: float = 0.0) -> Extent:
        """Return the extent of points ``(n, 2)``, with a margin around them."""
        low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
        (x, y), (width, height) = ((low + high) / 2).tolist(), (high - low).tolist()
        return cls((x, y), width, height)

    @property
    def zoom(self) -> float:
        """Zoom of a web map that shows all of it."""
        metres = max(self.width, self.height, 40.0)
        return min(float(np.log2(METRES_PER_POINT * EARTH_PANEL / metres)), CLOSEST)

    @property
    def eye(self) -> rrb.EyeControls3D:
        """Eye that sees all of it straight from above, north up."""
        above = EYE_OVER_HEIGHT * max(self.height, self.width / PANEL_ASPECT, 40.0)
        x, y = self.centre
        return rrb.EyeControls3D(
            position=(x, y - 0.001 * above, above), look_target=(x, y, 0.0), eye_up=(0.0, 1.0, 0.0)
        )


@dataclass(frozen=True)
class Content:
    """Content of a recording of a scene.

    Attributes:
        extent: of the drive and what lies around it.
        truth: whether there is ground truth.
        on_earth: whether the place on Earth is known.
        forecasts, memory: whether the network makes forecasts, and remembers rasters.
    """

    extent: Extent
    truth: bool
    on_earth: bool
    forecasts: bool = True
    memory: bool = True


def scene_blueprint(rig: Rig, bev_shape: tuple[int, int], content: Content, live: bool = False) -> rrb.Blueprint:
    """Lay out a scene.

    Args:
        rig: the cameras; without any, the map takes their place.
        bev_shape: rows and columns of the BEV panels, pixels.
        content: what there is to show.
        live: play at once, follow the newest frame, and show the map as it grows.
    """
    cameras = rrb.Grid(*[_camera_view(name) for name in _in_order(rig)], grid_columns=3 if len(rig) == 6 else None)
    above = rrb.Horizontal(cameras, _map_tabs(content, live), column_shares=[1.5, 1.0])
    columns = [_car_view(), _bev_column(content, bev_shape, 0), _bev_column(content, bev_shape, 1), _plots(content)]
    shares = [1.35, 1.0, 1.0, 0.85]
    shown = [(column, share) for column, share in zip(columns, shares, strict=True) if column is not None]
    return _blueprint(
        rrb.Vertical(
            above if rig else _map_tabs(content, live),
            rrb.Horizontal(*(column for column, _ in shown), column_shares=[share for _, share in shown]),
        ),
        rrb.TimePanel(state="collapsed", timeline="frame", fps=4.0, play_state="following" if live else None),
    )


def map_blueprint(extent: Extent, on_earth: bool) -> rrb.Blueprint:
    """Lay out finished maps, or what changed between two: one view from above, one on Earth where the place is known.

    Args:
        extent: of the maps.
        on_earth: whether their place on Earth is known.
    """
    view = rrb.Spatial3DView(origin="world", name="Map", background=BACKGROUND, eye_controls=extent.eye)
    shown = rrb.Tabs(view, _earth_view(extent), active_tab=0) if on_earth else view
    text = rrb.TextDocumentView(origin="description", name="What this is")
    return _blueprint(rrb.Horizontal(shown, text, column_shares=[3, 1]), rrb.TimePanel(state="hidden"))


def _blueprint(contents: rrb.Container, time: rrb.TimePanel) -> rrb.Blueprint:
    panels = rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed")
    return rrb.Blueprint(contents, *panels, time, auto_views=False, auto_layout=False)


def _in_order(rig: Rig) -> list[str]:
    names = [camera.name for camera in rig]
    return sorted(names, key=lambda name: CAMERA_ORDER.index(name) if name in CAMERA_ORDER else len(CAMERA_ORDER))


def _camera_view(name: str) -> rrb.Spatial2DView:
    """A picture with the tracks that the recorder projected into it, and nothing of the 3D world twice."""
    return rrb.Spatial2DView(origin=f"world/ego_vehicle/{name}", contents="$origin/**", name=name)


def _world_view(
    name: str, origin: str, eye: rrb.EyeControls3D, without: tuple[str, ...], truth: bool = False
) -> rrb.Spatial3DView:
    """A view of the world. Ground truth is there, but switched off unless asked for."""
    return rrb.Spatial3DView(
        origin=origin,
        contents=["+ world/**", *(f"- {entity}/**" for entity in without)],
        name=name,
        background=BACKGROUND,
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=eye,
        overrides={} if truth else {TRUTH: rrb.EntityBehavior(visible=False)},
    )


def _car_view() -> rrb.Spatial3DView:
    """The world as seen from behind and above the car; it stays with the car because the car is its origin."""
    eye = rrb.EyeControls3D(position=(-46.0, 0.0, 38.0), look_target=(2.0, 0.0, 0.0), eye_up=(0.0, 0.0, 1.0))
    return _world_view("Around the car", "world/ego_vehicle", eye, (WHOLE_MAP,))


def _map_tabs(content: Content, live: bool) -> rrb.Tabs:
    """The whole map from above; beside it, a click away, with ground truth, and on Earth."""
    without = () if live else (GROWING_MAP,)
    views: list[rrb.View] = [_world_view("The whole map", "world", content.extent.eye, without)]
    if content.truth:
        views.append(_world_view("With ground truth (grey)", "world", content.extent.eye, without, truth=True))
    if content.on_earth:
        views.append(_earth_view(content.extent))
    return rrb.Tabs(*views, active_tab=0)


def _earth_view(extent: Extent) -> rrb.MapView:
    return rrb.MapView(origin="earth", name="On Earth", zoom=extent.zoom, background=rrb.MapProvider.OpenStreetMap)


def _bev_column(content: Content, shape: tuple[int, int], column: int) -> rrb.Vertical | None:
    """Two panels from above: what is seen now and what was forecast; what all tracks and one of them remember."""
    panels = [_bev_view("Seen now (segmentation)", ["bev/segmentation", "bev/tracks"], shape)]
    if content.forecasts:
        panels.append(_bev_view("Forecast (dashed) and what came", ["bev/forecast", "bev/tracks"], shape))
    if column == 1:
        if not content.memory:
            return None
        panels = [
            _bev_view("What all tracks remember", ["bev/history", "bev/tracks"], shape),
            _bev_view("What one track remembers", ["bev/picked_track/**"], shape),
        ]
    return rrb.Vertical(*panels)


def _bev_view(name: str, contents: list[str], shape: tuple[int, int]) -> rrb.Spatial2DView:
    rows, columns = shape
    bounds = rrb.VisualBounds2D(x_range=[-8, columns + 8], y_range=[-8, rows + 8])
    contents = [*contents, "bev/car/**"]
    return rrb.Spatial2DView(origin="bev", contents=contents, name=name, background=BACKGROUND, visual_bounds=bounds)


def _plots(content: Content) -> rrb.Vertical:
    about = rrb.TextDocumentView(origin="description", name="About")
    times = _plot("plots/milliseconds", "Time, ms", rrb.PlotLegend(rrb.Corner2D.LeftTop))
    counts = rrb.Tabs(_plot("plots/elements", "Tracks"), times, active_tab=0)
    errors = [_plot("plots/forecast_error", "Forecast error, m")] if content.forecasts else []
    return rrb.Vertical(about, counts, *errors, row_shares=[1.4, 1.0, 1.0][: 2 + len(errors)])


def _plot(origin: str, name: str, legend: rrb.PlotLegend | None = None) -> rrb.TimeSeriesView:
    """A plot; one by kind needs no legend, since the colours are those of all views."""
    return rrb.TimeSeriesView(origin=origin, name=name, plot_legend=legend or rrb.PlotLegend(visible=False))
