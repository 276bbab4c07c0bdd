"""Cameras in the order that a network has learned: it has a code for each, so their names and places matter."""

from __future__ import annotations

from collections.abc import Sequence

from predmapnet.errors import UserError
from predmapnet.scenes import Rig


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
