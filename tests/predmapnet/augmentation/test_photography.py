"""Photographs taken again: repeatable, of every brightness, and untouched where nothing is asked for."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from predmapnet.augmentation.frames import AugmentationSettings, change_light
from predmapnet.augmentation.photography import PhotographySettings, tone_tables

NOTHING = PhotographySettings(**{field.name: 0.0 for field in fields(PhotographySettings)})


@pytest.fixture
def images() -> np.ndarray:
    """A rig of three with a smooth scene."""
    rows, columns = np.mgrid[0:48, 0:128]
    scene = 120 + 60 * np.sin(columns / 9) * np.cos(rows / 7)
    return np.stack([np.clip(scene + shift, 0, 255) for shift in (0, 20, -20)])[..., None].repeat(3, 3).astype(np.uint8)


def test_light_is_repeatable_and_another_draw_differs(images: np.ndarray) -> None:
    settings = AugmentationSettings()
    once, again, other = (change_light(images, settings, np.random.default_rng(seed)) for seed in (7, 7, 8))
    assert np.array_equal(once, again)
    assert not np.array_equal(once, other)
    assert once.shape == images.shape and once.dtype == np.uint8


def test_nothing_changes_where_nothing_is_asked_for(images: np.ndarray) -> None:
    still = AugmentationSettings(photography=NOTHING)
    assert np.array_equal(change_light(images, still, np.random.default_rng(7)), images)


@pytest.mark.parametrize("name", [field.name for field in fields(PhotographySettings)])
def test_each_effect_alone_changes_images(images: np.ndarray, name: str) -> None:
    strength = getattr(PhotographySettings(), name)
    one = AugmentationSettings(photography=replace(NOTHING, **{name: max(strength, 1.0)}))
    changed = [change_light(images, one, np.random.default_rng(seed)) for seed in range(8)]
    assert any(not np.array_equal(result, images) for result in changed)
    assert all(result.any() for result in changed), "an image that is black throughout shows nothing"


def test_exposures_reach_from_dark_to_burnt_out_but_mostly_stay_near() -> None:
    settings = replace(NOTHING, exposure=PhotographySettings().exposure)
    grey = np.array([tone_tables(1, settings, np.random.default_rng(seed))[0, 128, 0] for seed in range(600)])
    assert (grey < 70).mean() > 0.05
    assert (grey > 220).mean() > 0.03
    assert (np.abs(grey.astype(int) - 128) < 32).mean() > 0.4


def test_brighter_places_stay_brighter() -> None:
    for seed in range(100):
        tables = tone_tables(3, PhotographySettings(), np.random.default_rng(seed)).astype(int)
        assert (np.diff(tables, axis=1) >= 0).all()
