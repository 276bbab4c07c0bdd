"""What is computed once per camera rig, since cameras do not move on a car."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from predmapnet.config import BevFormerConfig, PredMapNetConfig
from predmapnet.errors import UserError
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


def in_learned_order(rig: Rig, cameras: Sequence[str], name: str) -> Rig:
    """Put the cameras of a rig where the network expects them, by their names.

    Args:
        rig: the cameras of a car, in any order.
        cameras: names in the order that the network has learned.
        name: of the network's configuration, for the message.

    Raises:
        UserError: the car has other cameras than the network has learned.
    """
    by_name = {camera.name: camera for camera in rig}
    lacking = [camera for camera in cameras if camera not in by_name]
    unknown = [camera for camera in by_name if camera not in cameras]
    if lacking or unknown:
        has = f"lacks {', '.join(lacking)}" if lacking else ""
        has += " and " if lacking and unknown else ""
        has += f"has {', '.join(unknown)}, which they do not know" if unknown else ""
        raise UserError(
            f"The weights of {name} have learned a code for each of {len(cameras)} cameras ({', '.join(cameras)}), "
            f"but this car {has}. Use weights that were trained with its cameras, or weights without such codes, as "
            "those that come with PredMapNet."
        )
    return tuple(by_name[camera] for camera in cameras)
