"""Camera images, as stored; damaged ones are noticed."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from predmapnet.datasets.undistortion import undistorted
from predmapnet.errors import UserError
from predmapnet.scenes import Camera

_JPEG_START = b"\xff\xd8"
_JPEG_END = b"\xff\xd9"
_AS_STORED = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION
"""Calibration belongs to the pixels as they are stored, so the EXIF orientation is not applied."""

_END_OR_STRAY = re.compile(rb"\xff[^\x00\xff\xd0-\xd7\xda\xc4\xdb-\xdd\xe0-\xef\xfe]", re.DOTALL)
"""The end, or else a byte after 0xFF that no writer puts into the pixels: no stuffed zero, restart or segment."""


def read_image(path: Path) -> NDArray[np.uint8]:
    """Read a JPEG or PNG file as ``(height, width, 3) uint8``, RGB; its EXIF orientation is not applied.

    Raises UserError for a file that is missing, empty, cut short, damaged or not an image.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UserError(f"Cannot read the image {path}: {error.strerror}.") from None
    # OpenCV fills a JPEG that was cut short or damaged with grey and says nothing that a program hears.
    if data[:2] == _JPEG_START:
        check_jpeg(data, f"The image {path}")
    image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), _AS_STORED) if data else None
    if image is None:
        raise UserError(f"{path} ({len(data)} bytes) is not an image that can be decoded. Copy or fetch it again.")
    return np.asarray(image, dtype=np.uint8)


def read_camera_image(path: Path, camera: Camera) -> NDArray[np.uint8]:
    """Read an image of a camera, undistorted: ``(camera.height, camera.width, 3) uint8``, RGB.

    Raises:
        UserError: as :func:`read_image`, or the image has not the size that its camera is calibrated for.
    """
    image = read_image(path)
    stored = camera if camera.lens is None else camera.lens
    if image.shape[:2] != (stored.height, stored.width):
        raise UserError(
            f"The image {path} has {image.shape[1]} x {image.shape[0]} pixels, "
            f"but the calibration of its camera is for {stored.width} x {stored.height}."
        )
    return undistorted(image, camera)


@dataclass(frozen=True)
class _Header:
    """Header of a JPEG: where its pixels begin (past thumbnails and comments), and whether it is a baseline JPEG."""

    pixels: int
    baseline: bool


def check_jpeg(data: bytes, where: str) -> None:
    """Raise UserError for a JPEG without an end, or with bytes in its pixels that no writer puts there.

    What some cameras write after the end does not matter.
    """
    header = _header(data)
    if header.baseline:
        found = _END_OR_STRAY.search(data, header.pixels)
        end = -1 if found is None else found.start()
    else:
        end = data.find(_JPEG_END, header.pixels)
    if end < 0:
        raise UserError(f"{where} is cut short after {len(data)} bytes. Copy or fetch it again.")
    if data[end : end + 2] != _JPEG_END:
        raise UserError(f"{where} is damaged at byte {end}. Copy or fetch it again.")


def _header(data: bytes) -> _Header:
    position, baseline = 2, False
    while position + 4 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        length = int.from_bytes(data[position + 2 : position + 4])
        if marker == 0xDA:
            return _Header(position + 2 + length, baseline)
        baseline |= marker == 0xC0
        # Fill bytes and markers without a length are passed over.
        if marker == 0xFF:
            position += 1
        elif marker == 0x01 or 0xD0 <= marker <= 0xD7:
            position += 2
        else:
            position += 2 + length
    return _Header(position, False)
