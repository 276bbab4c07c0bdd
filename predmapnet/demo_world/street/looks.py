"""Light and weather: what each look means in numbers, varied from scene to scene."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from mapfusion.arrays import Float32
from predmapnet.demo_world.world import Look


class Light(NamedTuple):
    """The light of a scene; colours are ``(3,) float32`` linear RGB radiance, a white wall in the sun being about 1.

    Attributes:
        sun_direction: ``(3,) float32``, unit vector towards the sun, global frame.
        sun: colour of direct light; zero without a sun.
        ambient: light from the whole sky on a level surface.
        zenith, horizon: colours of the sky.
        cloud: colour of clouds.
        cloud_cover: share of the sky under clouds, [0, 1].
        haze: extinction per metre.
        exposure: factor from radiance to sensor.
        noise: standard deviation of the sensor's noise at middle grey, share of full scale.
        wetness: 0 dry to 1 soaked.
        headlights: strength of the ego car's lamps.
        lit_windows: share of windows with light in them.
        lamps: strength of street lamps and of other cars' lights.
    """

    sun_direction: Float32
    sun: Float32
    ambient: Float32
    zenith: Float32
    horizon: Float32
    cloud: Float32
    cloud_cover: float
    haze: float
    exposure: float
    noise: float
    wetness: float
    headlights: float
    lit_windows: float
    lamps: float


def as_numbers(light: Light) -> Light:
    """Return a light with a tuple for each array: compiling the renderer's loops takes less long by far."""
    fields: list[Any] = [tuple(field.tolist()) if isinstance(field, np.ndarray) else field for field in light]
    return Light(*fields)


def _rgb(red: float, green: float, blue: float) -> Float32:
    return np.array([red, green, blue], dtype=np.float32)


def light_of(look: Look, seed: int) -> Light:
    """Return the light of a scene: the look decides the kind, the seed the hour, clouds and exposure."""
    generator = np.random.default_rng([seed, 101])
    azimuth = generator.uniform(0, 2 * np.pi)
    share = generator.uniform()
    elevation = np.radians({Look.DAY: 28 + 30 * share, Look.DUSK: 6 + 8 * share}.get(look, 40.0))
    direction = np.array(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], dtype=np.float32
    )
    exposure = float(np.exp(generator.normal(0, 0.13)))
    cover = float(generator.uniform(0.2, 0.75))
    hazy = float(generator.uniform(0.0006, 0.0022))
    if look is Look.DAY:
        return Light(
            direction, _rgb(2.5, 2.30, 1.95), _rgb(0.48, 0.58, 0.78), _rgb(0.22, 0.42, 0.85), _rgb(0.80, 0.92, 1.10),
            _rgb(1.25, 1.25, 1.25), cover, hazy, 0.72 * exposure, 0.010, 0.0, 0.0, 0.02, 0.0,
        )  # fmt: skip
    if look is Look.DUSK:
        return Light(
            direction, _rgb(1.15, 0.66, 0.32), _rgb(0.26, 0.26, 0.34), _rgb(0.16, 0.20, 0.38), _rgb(0.95, 0.55, 0.32),
            _rgb(0.70, 0.42, 0.38), cover, 1.5 * hazy, 0.95 * exposure, 0.018, 0.0, 0.25, 0.25, 0.35,
        )  # fmt: skip
    if look is Look.OVERCAST:
        return Light(
            direction, _rgb(0.0, 0.0, 0.0), _rgb(0.84, 0.88, 0.94), _rgb(0.78, 0.82, 0.88), _rgb(0.92, 0.94, 0.97),
            _rgb(0.62, 0.65, 0.70), 0.95, 2.0 * hazy, 0.92 * exposure, 0.012, 0.0, 0.0, 0.06, 0.0,
        )  # fmt: skip
    if look is Look.WET:
        return Light(
            direction, _rgb(0.0, 0.0, 0.0), _rgb(0.50, 0.53, 0.58), _rgb(0.48, 0.51, 0.56), _rgb(0.62, 0.64, 0.67),
            _rgb(0.38, 0.40, 0.44), 1.0, 2.2 * hazy, 0.98 * exposure, 0.016, 0.6 + 0.4 * share, 0.1, 0.15, 0.3,
        )  # fmt: skip
    return Light(
        direction, _rgb(0.0, 0.0, 0.0), _rgb(0.012, 0.013, 0.020), _rgb(0.006, 0.008, 0.016), _rgb(0.035, 0.030, 0.030),
        _rgb(0.02, 0.018, 0.018), cover, hazy, 1.5 * exposure, 0.040, 0.25 * float(share > 0.6), 1.0, 0.3, 1.0,
    )  # fmt: skip


def harder_light(light: Light, seed: int) -> Light:
    """Return the light of a training scene: often haze or fog, a low sun, or a sun half behind clouds."""
    generator = np.random.default_rng([seed, 103])
    kind, strength = generator.uniform(size=2)
    if kind < 0.12:
        # Visibility is about 3 / haze: from 60 m to 500 m.
        haze = float(0.006 * (0.05 / 0.006) ** strength)
        clear = float(np.exp(-20 * haze))
        grey = light.horizon.mean() + 0.3 * (light.horizon - light.horizon.mean())
        fog = np.asarray(grey * generator.uniform(0.75, 1.0), dtype=np.float32)
        ambient = light.ambient + 0.25 * (1 - clear) * light.sun
        return light._replace(
            haze=haze, sun=light.sun * np.float32(clear**2), ambient=ambient, horizon=fog,
            zenith=light.zenith + (fog - light.zenith) * np.float32(0.8), cloud=fog, cloud_cover=1.0,
        )  # fmt: skip
    light = light._replace(haze=light.haze * float(np.exp(generator.normal(0.3, 0.7))))
    if not light.sun.any():
        return light
    if kind < 0.40:
        elevation = np.radians(generator.uniform(4.0, 18.0))
        level = light.sun_direction[:2] / np.linalg.norm(light.sun_direction[:2])
        direction = np.array([*(level * np.cos(elevation)), np.sin(elevation)], dtype=np.float32)
        return light._replace(sun_direction=direction, ambient=light.ambient * np.float32(generator.uniform(0.6, 1.0)))
    # Clouds before the sun soften the contrast of shadows; a clear sky hardens it.
    veil = np.float32(generator.uniform(0.35, 1.25))
    return light._replace(sun=light.sun * veil, ambient=light.ambient * np.float32(np.sqrt(1.4 / (0.4 + veil))))
