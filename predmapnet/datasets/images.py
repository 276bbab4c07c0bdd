"""Camera images, as stored; damaged ones are noticed."""

from __future__ import annotations

import math
import re
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from predmapnet.datasets.undistortion import undistorted
from predmapnet.errors import UserError
from predmapnet.scenes import Camera, Image

_JPEG_START = b"\xff\xd8"
_JPEG_END = b"\xff\xd9"
_AS_STORED = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION
"""Calibration belongs to the pixels as they are stored, so the EXIF orientation is not applied."""

_PNG_START = b"\x89PNG\r\n\x1a\n"
_MARKER = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]", re.DOTALL)
"""Markers that end the pixels of a scan: no stuffed zero, and no restart."""
_SEGMENTS = {0xC4, 0xDA, 0xDB, 0xDC, 0xDD, *range(0xE0, 0xF0), 0xFE}
"""Markers of segments that may stand between scans."""
_FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
"""Markers of segments that tell the size of the image."""
MOST_PIXELS = 1 << 27
"""No camera of a car has more; a header that says so would only fill the memory."""


def read_image(path: Path) -> NDArray[np.uint8]:
    """Read a JPEG or PNG file as ``(height, width, 3) uint8``, RGB; its EXIF orientation is not applied.

    Raises UserError for a file that is missing, empty, cut short, damaged or not an image.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UserError(f"Cannot read the image {path}: {error.strerror}.") from None
    # OpenCV fills an image that was cut short or damaged with grey and says nothing that a program hears.
    stored_size(data, f"The image {path}")
    try:
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), _AS_STORED)
    except cv2.error:
        image = None
    if image is None:
        raise UserError(f"{path} ({len(data)} bytes) is not an image that can be decoded. Copy or fetch it again.")
    return np.asarray(image, dtype=np.uint8)


def read_camera_image(stored_image: Path | Image, camera: Camera) -> Image:
    """Return an image of a camera, from a file or as an array, undistorted: ``(camera.height, camera.width, 3)``, RGB.

    Raises:
        UserError: as :func:`read_image`, or the image has not the size that its camera is calibrated for.
    """
    if isinstance(stored_image, Path):
        image, name = read_image(stored_image), f"The image {stored_image}"
    else:
        image, name = stored_image, f"An image of {camera.name}"
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            raise UserError(f"{name} is {image.dtype} {image.shape}, not uint8 (height, width, 3), RGB.")
    stored = camera if camera.lens is None else camera.lens
    if image.shape[:2] != (stored.height, stored.width):
        raise UserError(
            f"{name} has {image.shape[1]} x {image.shape[0]} pixels, "
            f"but the calibration of its camera is for {stored.width} x {stored.height}."
        )
    return undistorted(image, camera)


def stored_size(data: bytes, where: str) -> tuple[int, int]:
    """Return width and height of a JPEG or PNG, of which no pixel is decoded.

    Raises UserError, which begins with ``where``, for one that is damaged, cut short, larger than any camera's, or
    something else.
    """
    if data.startswith(_JPEG_START):
        width, height = _checked_jpeg(data, where)
    elif data.startswith(_PNG_START):
        width, height = _checked_png(data, where)
    else:
        raise UserError(f"{where} ({len(data)} bytes) is neither a JPEG nor a PNG. Copy or fetch it again.")
    if width * height > MOST_PIXELS:
        raise UserError(f"{where} would have {width} x {height} pixels, as no camera has. Copy or fetch it again.")
    return width, height


def _checked_jpeg(data: bytes, where: str) -> tuple[int, int]:
    """Return width and height of a JPEG; UserError for one without an end, or with bytes that no writer puts there.

    What some cameras write after the end does not matter.
    """
    position, size = 2, (0, 0)
    scanning = False
    while True:
        if scanning:  # pixels, up to the next marker
            found = _MARKER.search(data, position)
            position = len(data) if found is None else found.start()
        if position + 4 > len(data) and data[position : position + 2] != _JPEG_END:
            raise UserError(f"{where} is cut short after {len(data)} bytes. Copy or fetch it again.")
        marker = data[position + 1]
        if data[position] != 0xFF or (scanning and marker not in _SEGMENTS and marker != _JPEG_END[1]):
            raise UserError(f"{where} is damaged at byte {position}. Copy or fetch it again.")
        if marker == _JPEG_END[1]:
            return size
        # Fill bytes and markers without a length are passed over.
        if marker == 0xFF:
            position += 1
        elif marker == 0x01 or 0xD0 <= marker <= 0xD7:
            position += 2
        else:
            if marker in _FRAMES:
                height, width = struct.unpack(">HH", data[position + 5 : position + 9].ljust(4, b"\0"))
                size = max(size, (width, height), key=math.prod)
            scanning |= marker == 0xDA
            position += 2 + max(2, int.from_bytes(data[position + 2 : position + 4]))


def _checked_png(data: bytes, where: str) -> tuple[int, int]:
    """Return width and height of a PNG; UserError for one without an end, or with a checksum that does not fit."""
    position = len(_PNG_START)
    while data[position + 4 : position + 8] != b"IEND":
        length = int.from_bytes(data[position : position + 4])
        end = position + 12 + length
        if end > len(data):
            raise UserError(f"{where} is cut short after {len(data)} bytes. Copy or fetch it again.")
        critical = not data[position + 4] & 0x20  # others say nothing of the pixels
        if critical and zlib.crc32(data[position + 4 : end - 4]) != int.from_bytes(data[end - 4 : end]):
            raise UserError(f"{where} is damaged between bytes {position} and {end}. Copy or fetch it again.")
        position = end
    width, height = struct.unpack(">II", data[16:24])
    return width, height
