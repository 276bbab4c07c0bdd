"""The cameras of the data sets, in the order of the official vector-map data sets."""

from __future__ import annotations

NUSCENES_CAMERAS = ("CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_FRONT_LEFT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT")

ARGOVERSE2_CAMERAS = (
    "ring_front_center",
    "ring_front_right",
    "ring_front_left",
    "ring_rear_right",
    "ring_rear_left",
    "ring_side_right",
    "ring_side_left",
)
