"""Images of ROS messages as files: compressed ones as they are, raw ones as JPEG."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from predmapnet.datasets.images import stored_size
from predmapnet.errors import UserError

COMPRESSED, RAW = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image"

JPEG, PNG = b"\xff\xd8", b"\x89PNG"
QUALITY = 95
"""Of the JPEG files that raw images become."""

AS_IT_IS = -1
CONVERSIONS = {
    "bgr8": (3, AS_IT_IS),
    "8UC3": (3, AS_IT_IS),
    "mono8": (1, AS_IT_IS),
    "8UC1": (1, AS_IT_IS),
    "rgb8": (3, cv2.COLOR_RGB2BGR),
    "rgba8": (4, cv2.COLOR_RGBA2BGR),
    "bgra8": (4, cv2.COLOR_BGRA2BGR),
    "bayer_rggb8": (1, cv2.COLOR_BayerRGGB2BGR),
    "bayer_bggr8": (1, cv2.COLOR_BayerBGGR2BGR),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGBRG2BGR),
    "bayer_grbg8": (1, cv2.COLOR_BayerGRBG2BGR),
    "yuv422": (2, cv2.COLOR_YUV2BGR_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2BGR_YUY2),
    "yuyv": (2, cv2.COLOR_YUV2BGR_YUY2),
}
"""Bytes per pixel of each encoding of raw images, and the conversion to OpenCV's order (blue, green, red)."""


def image_file(message: Any, kind: str) -> tuple[bytes, str]:
    """Return the content and the ending of an image file.

    Args:
        message: deserialised.
        kind: its type, :data:`COMPRESSED` or :data:`RAW`.

    Raises:
        UserError: the encoding is not one that is read here, or the image is damaged.
    """
    if kind == COMPRESSED:
        return _compressed(bytes(message.data), str(message.format))
    done, data = cv2.imencode(".jpg", _pixels(message), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    if not done:
        raise UserError("the image could not be written as JPEG")
    return data.tobytes(), ".jpg"


def image_size(message: Any, kind: str) -> tuple[int, int]:
    """Return width and height; raises UserError as :func:`image_file`."""
    if kind == RAW:
        height, width = _pixels(message).shape[:2]
        return width, height
    image = cv2.imdecode(np.frombuffer(image_file(message, kind)[0], dtype=np.uint8), cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise UserError(f"its images ('{message.format}') cannot be decoded")
    return image.shape[1], image.shape[0]


def _compressed(data: bytes, stated: str) -> tuple[bytes, str]:
    # A mosaic of colours that was compressed as if it were grey says so: "bayer_rggb8; jpeg compressed ".
    mosaic = stated.startswith("bayer") and "compressed bgr8" not in stated and "compressed rgb8" not in stated
    if mosaic or "compressedDepth" in stated or stated.startswith(("16UC1", "32FC1")):
        raise UserError(f"its images are '{stated}', no pictures in colours or grey")
    if data[:2] == JPEG or data[:4] == PNG:
        stored_size(data, "the image")
        return data, ".jpg" if data[:2] == JPEG else ".png"
    raise UserError(f"its images are '{stated}', neither JPEG nor PNG; republish them so (image_transport)")


def _pixels(message: Any) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Return a raw image as OpenCV has it: ``(height, width)`` grey or ``(height, width, 3)`` blue, green, red."""
    width, height, step = int(message.width), int(message.height), int(message.step)
    if message.encoding not in CONVERSIONS:
        raise UserError(f"its images have the encoding '{message.encoding}'; known are {', '.join(CONVERSIONS)}")
    channels, conversion = CONVERSIONS[message.encoding]
    if not width or not height or step < width * channels or len(message.data) < height * step:
        raise UserError(f"an image of {width} x {height} pixels in {len(message.data)} bytes is not whole")
    rows = np.asarray(message.data, dtype=np.uint8)[: height * step].reshape(height, step)[:, : width * channels]
    image = rows if channels == 1 else rows.reshape(height, width, channels)
    return np.asarray(image if conversion == AS_IT_IS else cv2.cvtColor(image, conversion), dtype=np.uint8)
