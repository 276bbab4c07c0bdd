"""Rigs of all kinds of cars: how many cameras, where they sit, how far they see, and how crookedly they are mounted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapfusion.arrays import Float
from predmapnet.demo_world.rig import DEMO_RIG
from predmapnet.scenes import Camera, Rig

DEMO_SHARE = 1 / 3
"""Share of the seeds that get the demo car."""
LOWEST, HIGHEST = 1.1, 2.8
"""Metres of the cameras above the road."""
NARROWEST, WIDEST = 40.0, 120.0
"""Degrees of the horizontal field of view."""
MOST_PITCH, MOST_ROLL = 12.0, 4.0
"""Degrees."""

_OPTICAL_TO_LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True)
class _Layout:
    """Directions of the cameras of one kind of rig.

    Attributes:
        yaws: degrees to the left of the car's heading, the first one ahead.
        fields: horizontal field of view of each, degrees.
        share: how often this layout is drawn, relative to the others.
    """

    yaws: tuple[float, ...]
    fields: tuple[float, ...]
    share: float


_LAYOUTS = (
    _Layout((0,), (85,), 1.0),
    _Layout((0, 180), (80, 95), 0.6),
    _Layout((0, 0), (105, 45), 0.4),
    _Layout((0, 50, -50), (65, 70, 70), 1.0),
    _Layout((0, 90, -90, 180), (100, 110, 110, 105), 1.5),
    _Layout((0, 45, -45, 90, -90), (55, 55, 55, 60, 60), 1.0),
    _Layout((0, 55, -55, 110, -110, 180), (65, 68, 68, 70, 70, 95), 2.5),
    _Layout((0, 60, -60, 120, -120, 180), (62, 65, 65, 65, 65, 62), 1.5),
    _Layout((0, 45, -45, 99, -99, 153, -153), (52, 60, 60, 60, 60, 60, 60), 1.5),
    _Layout((0, 0, 55, -55, 105, -105, 160, -160), (100, 48, 70, 70, 75, 75, 65, 65), 1.0),
)
_ASPECTS = (9 / 16, 9 / 16, 3 / 4, 2 / 3, 10 / 16, 0.45)
"""Height by width of the images that the cars' recorders store."""
_WIDTHS = (640, 800, 960, 1280, 1600, 1920)


def sample_rig(seed: int) -> Rig:
    """Draw the rig of one car: a third of the seeds get the demo car, the others a car of their own.

    Returns:
        One to eight cameras, the first one looking ahead. Ego axes are those of the car; its origin lies below the
        rear axle on the road, or above it (``ground_height`` is then negative), as data sets have it.
    """
    generator = np.random.default_rng([0x726967, seed])
    if generator.random() < DEMO_SHARE:
        return DEMO_RIG
    shares = np.array([layout.share for layout in _LAYOUTS])
    layout = _LAYOUTS[int(generator.choice(len(_LAYOUTS), p=shares / shares.sum()))]
    car = _Car.draw(generator)
    return tuple(
        _camera(f"CAMERA_{index}", yaw, field, car, generator)
        for index, (yaw, field) in enumerate(zip(layout.yaws, layout.fields, strict=True))
    )


@dataclass(frozen=True)
class _Car:
    """Common properties of the cameras of one car.

    Attributes:
        height: of the cameras above the road, metres.
        ground_height: z of the road in the ego frame, metres.
        front, rear, side: metres from the rear axle forward to the front and the rear cameras, and from the middle
            to those at the sides.
        pitch: degrees by which all cameras look down.
        stretch: factor of all fields of view.
        width, aspect: of the images, pixels, and height by width.
        crookedness: factor of all mounting errors.
    """

    height: float
    ground_height: float
    front: float
    rear: float
    side: float
    pitch: float
    stretch: float
    width: int
    aspect: float
    crookedness: float

    @classmethod
    def draw(cls, generator: np.random.Generator) -> _Car:
        """Draw a small car, a van or a lorry."""
        tall = generator.random() ** 1.6
        height = LOWEST + 0.15 + (HIGHEST - LOWEST - 0.3) * tall
        above = generator.random() < 0.45
        return cls(
            height=float(height),
            ground_height=-float(generator.uniform(0.15, 0.6)) if above else 0.0,
            front=float(generator.uniform(0.8, 2.2) + 1.8 * tall),
            rear=float(generator.uniform(-1.0, 0.8)),
            side=float(generator.uniform(0.3, 0.8) + 0.4 * tall),
            pitch=float(generator.normal(1.0, 2.0) + 2.5 * tall),
            stretch=float(np.exp(generator.normal(0, 0.10))),
            width=int(_WIDTHS[int(generator.integers(len(_WIDTHS)))]),
            aspect=float(_ASPECTS[int(generator.integers(len(_ASPECTS)))]),
            crookedness=float(generator.uniform(0.2, 1.5)),
        )


def _camera(name: str, yaw: float, field: float, car: _Car, generator: np.random.Generator) -> Camera:
    """One camera near its place on the car, its image cropped a little off centre."""
    crooked = car.crookedness
    field = float(np.clip(field * car.stretch * np.exp(generator.normal(0, 0.05)), NARROWEST, WIDEST))
    pitch = float(np.clip(car.pitch + generator.normal(0, 1.0) * crooked, -MOST_PITCH / 2, MOST_PITCH))
    roll = float(np.clip(generator.normal(0, 1.0) * crooked, -MOST_ROLL, MOST_ROLL))
    turn = yaw + generator.normal(0, 2.0) * crooked
    # A wider sensor is cropped: the field of view that is left need not lie around the principal point.
    width, height = car.width, round(car.width * car.aspect)
    focal = width / 2 / np.tan(np.radians(field / 2))
    centre = np.array([0.5, 0.5]) + generator.normal(0, [0.02, 0.03]) * crooked
    centre = np.clip(centre, 0.42, 0.58) * [width, height]
    skew = 1 + generator.normal(0, 0.004)
    intrinsics = np.array([[focal, 0.0, centre[0]], [0.0, focal * skew, centre[1]], [0.0, 0.0, 1.0]])
    forward = np.cos(np.radians(yaw))
    x = (car.rear + car.front) / 2 + forward * (car.front - car.rear) / 2 + generator.normal(0, 0.05)
    y = car.side * np.sin(np.radians(yaw)) + generator.normal(0, 0.03)
    z = float(np.clip(car.height + generator.normal(0, 0.06), LOWEST, HIGHEST)) + car.ground_height
    pose = np.eye(4)
    pose[:3, :3] = _turned(turn, pitch, roll)
    pose[:3, 3] = x, y, z
    return Camera(name, width, height, intrinsics, pose, car.ground_height)


def _turned(yaw: float, pitch: float, roll: float) -> Float:
    """Camera-to-ego rotation of a camera that looks ``yaw`` to the left and ``pitch`` down, degrees."""
    a, b, c = np.radians([yaw, pitch, roll])
    about_z = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(c), -np.sin(c)], [0, np.sin(c), np.cos(c)]])
    rotation: Float = about_z @ about_y @ about_x @ _OPTICAL_TO_LEVEL
    return rotation
