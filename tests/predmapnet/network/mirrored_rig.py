"""The rig of the mirrored world, camera by camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from predmapnet.scenes import Rig


def mirror_rig(rig: Rig) -> Rig:
    """Return the rig that sees the world mirrored at the x axis through horizontally flipped images.

    Training flips images and negates y of the truth, and hands the network the calibration of this rig.
    """
    mirror = np.diag([1.0, -1.0, 1.0])
    flip = np.diag([-1.0, 1.0, 1.0])
    cameras = []
    for camera in rig:
        pose = camera.camera_to_ego.copy()
        pose[:3, :3] = mirror @ pose[:3, :3] @ flip
        pose[:3, 3] = mirror @ pose[:3, 3]
        intrinsics = camera.intrinsics.copy()
        intrinsics[0, 2] = camera.width - intrinsics[0, 2]
        cameras.append(replace(camera, intrinsics=intrinsics, camera_to_ego=pose))
    return tuple(cameras)
