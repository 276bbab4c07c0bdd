"""The car and its cameras as entities of a recording."""

from __future__ import annotations

import numpy as np
import rerun as rr

from mapfusion.arrays import Float
from mapfusion.colours import Colour
from mapfusion.elements import RegionOfInterest
from predmapnet.recording.map_lines import lifted
from predmapnet.scenes import Rig

CAR_SIZE_METRES = (4.6, 1.9, 1.6)
CAR_COLOUR: Colour = (235, 235, 240)
ROI_COLOUR: Colour = (70, 74, 84)


def car_outline() -> Float:
    """Return the car from above, ``(5, 2)``, metres, ego frame.

    The ego origin lies over the rear axle (Argoverse 2) or under the lidar, ahead of it (nuScenes).
    """
    corners = [[-0.3, -0.5], [0.7, -0.5], [0.7, 0.5], [-0.3, 0.5], [-0.3, -0.5]]
    outline: Float = np.array(corners) * np.array(CAR_SIZE_METRES[:2])
    return outline


def roi_corners(roi: RegionOfInterest) -> Float:
    """Return the border of the region of interest, ``(5, 2)``, metres, ego frame."""
    return np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * roi.size / 2


def log_car(recording: rr.RecordingStream, rig: Rig, roi: RegionOfInterest) -> None:
    """Log what moves with the car and never changes: its body, the region of interest and the cameras."""
    length, _, height = CAR_SIZE_METRES
    box = rr.Boxes3D(
        centers=[[0.2 * length, 0.0, height / 2]], sizes=[CAR_SIZE_METRES], colors=CAR_COLOUR, fill_mode="solid"
    )
    border = rr.LineStrips3D([lifted(roi_corners(roi), 0.0)], colors=ROI_COLOUR, radii=rr.Radius.ui_points(0.6))
    recording.log("world/ego_vehicle/car", box, static=True)
    recording.log("world/ego_vehicle/region_of_interest", border, static=True)
    for camera in rig:
        pose = rr.Transform3D(translation=camera.camera_to_ego[:3, 3], mat3x3=camera.camera_to_ego[:3, :3])
        lens = rr.Pinhole(
            image_from_camera=camera.intrinsics,
            resolution=(camera.width, camera.height),
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=2.2,
            color=(110, 115, 125),
            line_width=0.02,
        )
        recording.log(f"world/ego_vehicle/{camera.name}", pose, lens, static=True)
