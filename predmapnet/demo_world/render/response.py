"""Camera response, from light to bytes: exposure, white balance and tone curve."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapfusion.arrays import Byte, Float

CURVE_LENGTH = 4096
CURVE_END = 1.25
"""Square root of the linear light at the last entry of a tone curve."""


@dataclass(frozen=True)
class Response:
    """The cameras of one car.

    Attributes:
        exposure: factor on what the scene's light asks for.
        drift: standard deviation of the exposure from camera to camera and over time, as a logarithm.
        balance: factors of red, green and blue.
        gamma: exponent on the encoded values; above 1 darkens the middle.
        knee: linear light above which the curve bends towards white; 1 cuts whites off.
        black: share of full scale that black becomes.
        blur: standard deviation of the lens's blur, pixels of an image 800 wide.
        noise: factor on the noise of the scene's light.
    """

    exposure: float = 1.0
    drift: float = 0.06
    balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    gamma: float = 1.0
    knee: float = 0.6
    black: float = 0.0
    blur: float = 0.5
    noise: float = 1.0

    def tone_curve(self) -> Byte:
        """Return bytes ``(4096,)`` over the square root of linear light, from 0 to 1.25."""
        linear = np.linspace(0.0, CURVE_END, CURVE_LENGTH) ** 2
        room = max(1.0 - self.knee, 1e-6)
        bent = self.knee + room * -np.expm1(-np.maximum(linear - self.knee, 0.0) / room)
        bent = np.where(linear < self.knee, linear, bent)
        encoded = np.where(bent <= 0.0031308, 12.92 * bent, 1.055 * bent ** (1 / 2.4) - 0.055)
        shaped = self.black + (1 - self.black) * np.clip(encoded, 0, 1) ** self.gamma
        curve: Byte = np.round(shaped * 255).astype(np.uint8)
        return curve

    def exposures(self, frames: int, generator: np.random.Generator) -> Float:
        """Draw one camera's exposure at each frame, ``(frames,)``: a constant of its own and a slow wander."""
        wander = np.convolve(generator.standard_normal(frames + 7), np.hanning(10)[1:-1], mode="valid")
        factors: Float = self.exposure * np.exp(self.drift * (generator.standard_normal() + 0.4 * wander))
        return factors


def draw_response(seed: int) -> Response:
    """Draw the cameras of a training scene: two of five expose too little or too much, up to burnt out."""
    generator = np.random.default_rng([0x72657370, seed])
    extreme = generator.random() < 0.4
    exposure = generator.uniform(-1.5, 1.1) if extreme else generator.normal(0, 0.2)
    red, green, blue = np.exp(generator.normal(0, 0.08, 3) * [1.0, 0.4, 1.0])
    return Response(
        exposure=float(np.exp(exposure)),
        drift=float(generator.uniform(0.04, 0.18)),
        balance=(float(red), float(green), float(blue)),
        gamma=float(np.exp(generator.normal(0, 0.15))),
        knee=float(generator.uniform(0.35, 0.95)),
        black=float(max(0.0, generator.normal(0.0, 0.03))),
        blur=float(generator.uniform(0.3, 1.1)),
        noise=float(np.exp(generator.normal(-0.3, 0.5))),
    )
