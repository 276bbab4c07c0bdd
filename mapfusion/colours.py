"""The one colour language of recordings, reports, styles and pictures: kinds, changes, truth."""

from __future__ import annotations

from typing import TypeAlias

from mapfusion.elements import ElementKind

Colour: TypeAlias = tuple[int, int, int]
"""Red, green and blue, 0 to 255."""

KIND_COLOURS: dict[ElementKind, Colour] = {
    ElementKind.PED_CROSSING: (86, 180, 233),
    ElementKind.DIVIDER: (255, 176, 0),
    ElementKind.BOUNDARY: (64, 214, 137),
}
"""Okabe and Ito's sky blue, orange and green, brightened for :data:`BACKGROUND`: distinct to colour-blind eyes."""

CHANGE_COLOURS: dict[str, Colour] = {
    "added": (245, 245, 250),
    "removed": (255, 72, 72),
    "moved": (210, 100, 255),
    "unchanged": (100, 104, 114),
    "unobserved": (70, 62, 110),
}
"""By the values of :class:`mapfusion.diff.Change`; none of them is taken for a kind."""

TRUTH_COLOUR: Colour = (125, 125, 130)
"""Ground truth: a grey that stays behind everything."""

BACKGROUND: Colour = (14, 16, 20)
"""Of every drawing of a map."""


def lighter(colour: Colour, share: float = 0.55) -> Colour:
    """Blend a colour with white; forecasts are drawn so."""
    red, green, blue = (round(channel + (255 - channel) * share) for channel in colour)
    return red, green, blue


def darker(colour: Colour, share: float = 0.45) -> Colour:
    """Blend a colour with black: a growing map behind its tracks, and lines and text on white."""
    red, green, blue = (round(channel * (1 - share)) for channel in colour)
    return red, green, blue


def web_colour(colour: Colour) -> str:
    """Return a colour as HTML, CSS and SVG write it: ``#rrggbb``."""
    return "#{:02x}{:02x}{:02x}".format(*colour)
