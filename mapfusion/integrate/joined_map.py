"""Elements of the map, joined; only around changed elements are lines joined anew."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain

import numpy as np

from mapfusion.arrays import Float
from mapfusion.elements import MapElement
from mapfusion.integrate.config import IntegratorConfig
from mapfusion.integrate.joining import Ends, all_ends, ends_of, joined_along, links_between
from mapfusion.integrate.tile_index import TileIndex
from mapfusion.integrate.views import ViewGrid


class JoinedMap:
    """Elements of all lines and crossings, joined where lines go on in each other, and kept up to date.

    Which ends are linked depends on both of them and on what was looked at between them, so a change reaches no
    further than the lines that were or are linked with what changed, directly or through others.
    """

    def __init__(self) -> None:
        self._extracted: dict[int, tuple[list[MapElement], Ends]] = {}
        self._linked: dict[int, set[int]] = {}
        self._tips = TileIndex()
        self._changed: set[int] = set()
        self._joined: dict[int, list[MapElement]] = {}

    def put(self, number: int, elements: list[MapElement]) -> None:
        """Replace the elements of one line or crossing; none to forget it."""
        if elements:
            ends = ends_of(elements)
            self._extracted[number] = elements, ends
            self._tips.put(number, ends.tip)
        elif number in self._extracted:
            del self._extracted[number]
            self._tips.remove(number)
        else:
            return
        self._changed.add(number)

    def looked_at(self, low: Float, high: Float, config: IntegratorConfig) -> None:
        """Note that the car looked at a box ``low`` to ``high``, metres: lines that end around it may part again."""
        self._changed.update(self._tips.near(low - config.join_gap, high + config.join_gap))

    def elements(self, views: ViewGrid, config: IntegratorConfig) -> tuple[MapElement, ...]:
        """Return the joined elements, in the order of the least number in each."""
        if self._changed:
            self._join_anew(self._link_anew(views, config), views, config)
            self._changed.clear()
        return tuple(chain.from_iterable(self._joined[number] for number in sorted(self._joined)))

    def _link_anew(self, views: ViewGrid, config: IntegratorConfig) -> set[int]:
        """Link the changed ones anew; returns the numbers of all whose joints may differ from before."""
        touched = set(self._changed)
        for number in self._changed:
            for other in self._linked.pop(number, ()):
                touched.add(other)
                self._linked.get(other, set()).discard(number)
        changed = [number for number in self._changed if number in self._extracted]
        tips = np.concatenate([np.zeros((0, 2)), *(self._extracted[number][1].tip for number in changed)])
        around = sorted(self._tips.around(tips, config.join_gap))
        several = [self._extracted[number] for number in around]
        owner = np.repeat(around, [len(elements) for elements, _ in several]).tolist()
        for link in links_between(_elements(several), all_ends(several), views, config):
            one, two = (owner[element] for element, _ in link.ends)
            if one in self._changed or two in self._changed:
                self._linked.setdefault(one, set()).add(two)
                self._linked.setdefault(two, set()).add(one)
        return self._with_linked(touched)

    def _with_linked(self, numbers: Iterable[int]) -> set[int]:
        """Return numbers and all that are linked with them, directly or through others."""
        found = set(numbers)
        open_ends = list(found)
        while open_ends:
            further = self._linked.get(open_ends.pop(), set()) - found
            found |= further
            open_ends.extend(further)
        return found

    def _join_anew(self, numbers: set[int], views: ViewGrid, config: IntegratorConfig) -> None:
        for number in numbers:
            self._joined.pop(number, None)
        present = sorted(number for number in numbers if number in self._extracted)
        several = [self._extracted[number] for number in present]
        owner = np.repeat(present, [len(elements) for elements, _ in several]).tolist()
        elements = _elements(several)
        links = links_between(elements, all_ends(several), views, config)
        for first, element in joined_along(elements, links):
            self._joined.setdefault(owner[first], []).append(element)


def _elements(several: list[tuple[list[MapElement], Ends]]) -> list[MapElement]:
    return [element for elements, _ in several for element in elements]
