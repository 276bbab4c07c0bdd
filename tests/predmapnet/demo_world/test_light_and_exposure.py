"""Cameras that expose as they like, and the light of training scenes."""

from dataclasses import replace

import numpy as np
import pytest

from predmapnet.demo_world.render.renderer import Renderer
from predmapnet.demo_world.render.response import Response, draw_response
from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.demo_world.street.dressing import dress
from predmapnet.demo_world.street.looks import harder_light, light_of
from predmapnet.demo_world.world import Look
from predmapnet.scenes import Camera

FRONT = DEMO_RIG[0]
SMALL = Camera(FRONT.name, 256, 144, np.diag([0.32, 0.32, 1.0]) @ FRONT.intrinsics, FRONT.camera_to_ego)
PLAIN = Response(drift=0.0, knee=1.0, blur=0.0, noise=0.0)
"""No tone curve but the encoding of sRGB, and nothing drawn at random but the vignette."""


@pytest.fixture(scope="module")
def linear(street):
    """A function that renders the street by one response, decoded to linear light in [0, 1]."""
    world = dress(*street, Look.OVERCAST, 4, "a")

    def render(response):
        encoded = Renderer(world, 1, response=response, texel=0.3).render(SMALL, 5).image / 255.0
        return np.where(encoded < 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)

    return render


def test_exposure_and_balance_act_once_on_linear_light(linear):
    usual, brighter = linear(replace(PLAIN, exposure=0.5)), linear(replace(PLAIN, balance=(0.8, 1.0, 1.2)))
    clear = (usual > 0.03) & (usual < 0.45) & (brighter < 0.95)
    ratios = [
        np.median((brighter / np.maximum(usual, 1e-3))[..., channel][clear[..., channel]]) for channel in range(3)
    ]
    np.testing.assert_allclose(ratios, [1.6, 2.0, 2.4], rtol=0.04)


def test_exposure_wanders_slowly_and_around_what_is_asked():
    wanders = [replace(PLAIN, exposure=2.0, drift=0.1).exposures(40, np.random.default_rng(n)) for n in range(200)]
    logs = np.log(wanders)
    assert abs(logs.mean() - np.log(2.0)) < 0.03
    assert logs.std(axis=1).mean() > 0.02
    assert np.abs(np.diff(logs)).max() < 0.15


@pytest.mark.parametrize("seed", range(0, 200, 10))
def test_tone_curves_rise_and_use_the_whole_range(seed):
    curve = draw_response(seed).tone_curve().astype(int)
    assert (np.diff(curve) >= 0).all()
    assert curve[0] < 40 and curve[-1] > 235


def test_cameras_of_training_scenes_expose_from_too_dark_to_burnt_out():
    exposures = np.array([draw_response(seed).exposure for seed in range(400)])
    assert exposures.min() < 0.3 and exposures.max() > 2.5
    assert 0.5 < np.mean((exposures > 0.67) & (exposures < 1.5)) < 0.85


def test_some_training_scenes_lie_in_fog_some_under_a_low_sun_and_none_gets_a_sun_it_had_not():
    fog, low = [], []
    for seed in range(300):
        light = harder_light(light_of(Look.DAY, seed), seed)
        fog.append(light.haze > 0.0059)
        low.append(light.sun_direction[2] < np.sin(np.radians(20.0)))
        assert 3.0 / light.haze > 55.0, "fog may hide what is far, not the road ahead"
        assert np.linalg.norm(light.sun_direction) == pytest.approx(1.0, abs=1e-5)
        assert not harder_light(light_of(Look.NIGHT, seed), seed).sun.any()
    assert 0.07 < np.mean(fog) < 0.25
    assert 0.15 < np.mean(low) < 0.4
