"""Camera images; damaged ones are noticed."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from predmapnet.errors import UserError

_JPEG_START = b"\xff\xd8"
_JPEG_END = b"\xff\xd9"
_AS_STORED = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION
"""Calibration belongs to the pixels as they are stored, so the EXIF orientation is not applied."""


def read_image(path: Path) -> NDArray[np.uint8]:
    """Read an image.

    Args:
        path: a JPEG or PNG file.

    Returns:
        ``(height, width, 3) uint8``, RGB.

    Raises:
        UserError: the file is missing, empty, cut short or not an image.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UserError(f"Cannot read the image {path}: {error.strerror}.") from None
    # OpenCV fills a JPEG that was cut short with grey and says nothing, so the end marker is looked for here.
    if data[:2] == _JPEG_START and not _has_end(data):
        raise UserError(f"The image {path} is cut short after {len(data)} bytes. Copy or fetch it again.")
    image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), _AS_STORED) if data else None
    if image is None:
        raise UserError(f"{path} ({len(data)} bytes) is not an image that can be decoded. Copy or fetch it again.")
    return np.asarray(image, dtype=np.uint8)


def _start_of_scan(data: bytes) -> int:
    """Return where the pixels of a JPEG begin, past thumbnails and comments that have end markers of their own."""
    position = 2
    while position + 4 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xDA:
            return position
        # Fill bytes and markers without a length are passed over.
        alone = marker == 0xFF or marker == 0x01 or 0xD0 <= marker <= 0xD7
        step = 1 if marker == 0xFF else 2
        position += step if alone else 2 + int.from_bytes(data[position + 2 : position + 4])
    return position


def _has_end(data: bytes) -> bool:
    """Whether the pixels of a JPEG have an end marker; what some cameras write after it does not matter."""
    scan = _start_of_scan(data)
    return data.find(_JPEG_END, max(scan, len(data) - 64)) >= 0 or data.find(_JPEG_END, scan) >= 0
