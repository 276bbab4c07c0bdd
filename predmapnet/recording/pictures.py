"""Pictures of the cameras, small enough for a recording: at most a third of a megabyte for all of a frame."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import rerun as rr

from predmapnet.datasets.images import read_camera_image
from predmapnet.scenes import Camera, Image, Rig

FRAME_BYTES = 330_000
"""Of all pictures of a frame together."""

WIDEST = 800
"""Pixels; wider pictures are made smaller."""

QUALITIES = (85, 75, 65, 55, 45, 35)
"""Of JPEG; the first that is small enough is taken."""


class Pictures:
    """Pictures of one rig; a file that is small enough goes in as it is, without loss and in no time.

    Attributes:
        rig: the cameras of the pictures, whose pixels lines are drawn in.
    """

    def __init__(self, rig: Rig) -> None:
        self.rig = tuple(_narrowed(camera) for camera in rig)
        self._cameras = {camera.name: (camera, small) for camera, small in zip(rig, self.rig, strict=True)}
        self._share = FRAME_BYTES // max(1, len(rig))
        self._quality = dict.fromkeys(self._cameras, 0)

    def encoded(self, name: str, stored: Path | Image) -> rr.EncodedImage:
        """Return the picture of a camera from its image, a file or an array."""
        camera, small = self._cameras[name]
        fits = camera.lens is None and camera.width == small.width
        if isinstance(stored, Path) and fits and stored.stat().st_size <= self._share:
            return rr.EncodedImage(path=stored)
        image = read_camera_image(stored, camera)
        if small.width < camera.width:
            image = np.asarray(cv2.resize(image, (small.width, small.height), interpolation=cv2.INTER_AREA), np.uint8)
        content = b""
        for place in range(self._quality[name], len(QUALITIES)):
            self._quality[name] = place
            content = _jpeg(image, QUALITIES[place])
            if len(content) <= self._share:
                break
        return rr.EncodedImage(contents=content, media_type="image/jpeg")


def _jpeg(image: Image, quality: int) -> bytes:
    encoded = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return encoded.tobytes()


def _narrowed(camera: Camera) -> Camera:
    """Return a camera of at most :data:`WIDEST` pixels that sees the same."""
    scale = WIDEST / camera.width
    if scale >= 1.0:
        return camera
    height = round(camera.height * scale)
    factors = np.diag([scale, height / camera.height, 1.0])
    return replace(camera, width=WIDEST, height=height, intrinsics=factors @ camera.intrinsics, lens=None)
