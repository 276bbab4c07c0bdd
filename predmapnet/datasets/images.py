"""Camera images; damaged ones are noticed."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from predmapnet.errors import UserError

_JPEG_START = b"\xff\xd8"
_JPEG_END = b"\xff\xd9"


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
    if data[:2] == _JPEG_START and _JPEG_END not in data[-64:]:
        raise UserError(f"The image {path} is cut short after {len(data)} bytes. Copy or fetch it again.")
    image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR_RGB) if data else None
    if image is None:
        raise UserError(f"{path} ({len(data)} bytes) is not an image that can be decoded. Copy or fetch it again.")
    return np.asarray(image, dtype=np.uint8)
