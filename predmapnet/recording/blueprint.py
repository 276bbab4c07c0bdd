"""The layout of a recording: cameras above, the world, the BEV panel and the plots below."""

from __future__ import annotations

import rerun as rr
import rerun.blueprint as rrb

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


def scene_blueprint(rig: Rig, bev_shape: tuple[int, int], play: bool = False) -> rrb.Blueprint:
    """Lay out a scene whose BEV panel has so many rows and columns of pixels.

    ``play`` starts at once and follows the newest frame (for live viewing).
    """
    cameras = rrb.Grid(*[_camera_view(name) for name in _in_order(rig)], grid_columns=3 if len(rig) == 6 else None)
    bev = rrb.Vertical(
        _bev_view("segmentation", "Map from above, now (segmentation)", bev_shape),
        _bev_view("history", "What the tracks remember (history masks)", bev_shape),
    )
    plots = rrb.Vertical(
        rrb.TextDocumentView(origin="description", name="What this is"),
        _plot("plots/elements", "Tracked elements"),
        _plot("plots/milliseconds", "Milliseconds per frame"),
        row_shares=[1.1, 1.1, 1.1],
    )
    return rrb.Blueprint(
        rrb.Vertical(
            cameras,
            rrb.Horizontal(_world_view(), bev, plots, column_shares=[1.4, 1.0, 0.8]),
            row_shares=[1.0, 1.05],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="frame", fps=4.0, play_state="following" if play else None),
        auto_views=False,
        auto_layout=False,
    )


def map_blueprint(centre: tuple[float, float], extent: float) -> rrb.Blueprint:
    """Lay out a finished map, its larger side ``extent`` metres, seen straight from above its middle."""
    eye = rrb.EyeControls3D(
        position=(centre[0], centre[1] - 0.25 * extent, 1.0 * extent), look_target=(*centre, 0.0), eye_up=(0, 0, 1)
    )
    view = rrb.Spatial3DView(origin="world", name="Map", background=BACKGROUND, eye_controls=eye)
    text = rrb.TextDocumentView(origin="description", name="What this is")
    return rrb.Blueprint(
        rrb.Horizontal(view, text, column_shares=[3, 1]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def _in_order(rig: Rig) -> list[str]:
    names = [camera.name for camera in rig]
    return sorted(names, key=lambda name: CAMERA_ORDER.index(name) if name in CAMERA_ORDER else len(CAMERA_ORDER))


def _camera_view(name: str) -> rrb.Spatial2DView:
    """A picture with the tracks that the recorder projected into it, and nothing of the 3D world twice."""
    origin = f"world/ego_vehicle/{name}"
    return rrb.Spatial2DView(origin=origin, contents="$origin/**", name=name)


def _world_view() -> rrb.Spatial3DView:
    """The world as seen from behind and above the car; it stays with the car because the car is its origin."""
    eye = rrb.EyeControls3D(position=(-46.0, 0.0, 38.0), look_target=(2.0, 0.0, 0.0), eye_up=(0.0, 0.0, 1.0))
    return rrb.Spatial3DView(
        origin="world/ego_vehicle",
        contents="world/**",
        name="World: tracks bright, map dark, forecast dashed, truth grey",
        background=BACKGROUND,
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=eye,
    )


def _plot(origin: str, name: str) -> rrb.TimeSeriesView:
    legend = rrb.PlotLegend(corner=rrb.Corner2D.RightTop)
    return rrb.TimeSeriesView(origin=origin, name=name, plot_legend=legend)


def _bev_view(entity: str, name: str, shape: tuple[int, int]) -> rrb.Spatial2DView:
    rows, columns = shape
    bounds = rrb.VisualBounds2D(x_range=[-8, columns + 8], y_range=[-8, rows + 8])
    return rrb.Spatial2DView(
        origin="bev",
        contents=[f"bev/{entity}", "bev/tracks/**", "bev/car/**"],
        name=name,
        background=BACKGROUND,
        visual_bounds=bounds,
    )


WORLD_COORDINATES = rr.ViewCoordinates.RIGHT_HAND_Z_UP
