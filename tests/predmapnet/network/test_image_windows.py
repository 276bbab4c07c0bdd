"""Only the rows that a window needs are scaled, and they are those of the whole scaled image."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from predmapnet.config import ImageWindowConfig
from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.network.image_input import crop_image, image_window


@pytest.mark.parametrize(("width", "height"), [(800, 450), (1600, 900), (1550, 2048), (704, 256), (256, 144)])
@pytest.mark.parametrize("horizon", [0.3, 0.5, 0.7])
def test_a_window_is_what_is_cut_from_the_scaled_image(width, height, horizon):
    config = ImageWindowConfig()
    image = np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)
    intrinsics = np.array([[width, 0.0, width / 2], [0.0, width, horizon * height], [0.0, 0.0, 1.0]])
    camera = replace(DEMO_RIG[0], width=width, height=height, intrinsics=intrinsics)
    window = image_window(camera, config)
    size = (window.scaled_width, window.scaled_height)
    scaled = cv2.resize(image, size, interpolation=cv2.INTER_AREA)[window.top : window.top + config.height]
    found = crop_image(image, camera, config)
    assert np.array_equal(found[: len(scaled)], scaled)
    assert not found[len(scaled) :].any()
