"""What is computed once per camera rig, since cameras do not move on a car."""

from __future__ import annotations

import torch

from predmapnet.config import BevFormerConfig, PredMapNetConfig
from predmapnet.datasets.source import Rig
from predmapnet.errors import UserError
from predmapnet.network.camera_pillars import make_camera_pillars
from predmapnet.network.image_input import ego_to_image, input_size
from predmapnet.network.interface import RigGeometry
from predmapnet.network.view_transform import make_rig_lookup


def make_rig_geometry(rig: Rig, config: PredMapNetConfig) -> RigGeometry:
    """Find where the cameras of a rig see the ground, in the form that the BEV encoder of ``config`` takes.

    Args:
        rig: cameras at the size of their stored images; scaling is taken care of here.
        config: of the network.

    Raises:
        UserError: the network has learned with another number of cameras.
    """
    if not isinstance(config.bev, BevFormerConfig):
        return make_rig_lookup(rig, config)
    if len(rig) != config.bev.cameras:
        raise UserError(f"{config.name} takes {config.bev.cameras} cameras, but this rig has {len(rig)}.")
    projections = torch.from_numpy(ego_to_image(rig, config.image))
    return make_camera_pillars(projections, input_size(config.image), config.bev, config.roi)
