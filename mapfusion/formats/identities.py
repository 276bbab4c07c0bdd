"""Names of elements that are the same from run to run, and numbers made of them where a format wants numbers."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import count

from mapfusion.elements import MapElement

DIGITS = 10
"""Hexadecimal digits of a name; 40 bits keep a million elements apart."""

NUMBERS = 1 << 48
"""Numbers are smaller than this, which every program reads exactly."""


def digest_name(label: str, *what: object) -> str:
    """Return a name that depends on what is given alone: ``divider-1f0c9a27d3``."""
    return f"{label}-{hashlib.sha256(repr(what).encode()).hexdigest()[:DIGITS]}"


def element_name(element: MapElement) -> str:
    """Return the name of an element, or one made of its kind and its first track; of its place if it has no track."""
    if element.name:
        return element.name
    tracks = ((source, ids[0]) for source, ids in sorted(element.origins.items()) if ids)
    return digest_name(element.kind.label, next(tracks, element.points[0].round(1).tolist()))


class ElementNames:
    """Names given so far: parts of one element and copies of it get a number behind its name."""

    def __init__(self) -> None:
        self._given: set[str] = set()

    def named(self, element: MapElement) -> MapElement:
        """Return an element with a name that no other has."""
        name = element_name(element)
        own = (
            name
            if name not in self._given
            else next(f"{name}-{n}" for n in count(2) if f"{name}-{n}" not in self._given)
        )
        self._given.add(own)
        return element if own == element.name else replace(element, name=own)


def all_named(elements: Iterable[MapElement]) -> Iterator[MapElement]:
    """Yield elements with names, all different."""
    return map(ElementNames().named, elements)


class StableNumbers:
    """Positive numbers of names, all different; a name has the same number in every file, but for rare collisions."""

    def __init__(self) -> None:
        self._given: set[int] = set()

    def of(self, name: str) -> int:
        """Return the number of a name that was not asked for before."""
        number = int(hashlib.sha256(name.encode()).hexdigest(), 16) % NUMBERS + 1
        while number in self._given:
            number += 1
        self._given.add(number)
        return number
