"""What is computed once per camera rig, since cameras do not move on a car."""

from __future__ import annotations

import torch

from predmapnet.config import BevFormerConfig, PredMapNetConfig
from predmapnet.errors import UserError
from predmapnet.network.camera_order import in_learned_order
from predmapnet.network.image_input import ego_to_image, input_size
from predmapnet.network.maptracker.camera_pillars import make_camera_pillars
from predmapnet.network.small.ground_lookup import make_rig_lookup
from predmapnet.network.state import RigGeometry
from predmapnet.scenes import Rig


def arranged_rig(rig: Rig, config: PredMapNetConfig) -> Rig:
    """Put the cameras of a rig in the order in which the network takes their images.

    Raises:
        UserError: the network has learned with other cameras.
    """
    if not isinstance(config.bev, BevFormerConfig):
        return rig
    return in_learned_order(rig, config.bev.cameras, config.name)


def make_rig_geometry(rig: Rig, config: PredMapNetConfig) -> RigGeometry:
    """Find where the cameras of a rig see the ground, in the form that the BEV encoder of ``config`` takes.

    Args:
        rig: cameras at the size of their stored images, in the order of :func:`arranged_rig`; scaling is taken care of
            here.
        config: of the network.

    Raises:
        UserError: the network has learned with other cameras, or in another order.
    """
    if not isinstance(config.bev, BevFormerConfig):
        return make_rig_lookup(rig, config)
    names = [camera.name for camera in rig]
    if [camera.name for camera in arranged_rig(rig, config)] != names:
        expected = ", ".join(config.bev.cameras)
        raise UserError(f"{config.name} takes its cameras in the order {expected}; these are {', '.join(names)}.")
    projections = torch.from_numpy(ego_to_image(rig, config.image))
    return make_camera_pillars(projections, input_size(config.image), config.bev, config.roi)
