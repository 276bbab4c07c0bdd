"""Chains of lines: which lines go on in each other, each end used once."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeAlias, TypeVar

Line = TypeVar("Line")
LineEnd: TypeAlias = tuple[int, int]
"""Number of a line, and 0 for its start or -1 for its end."""


@dataclass(frozen=True)
class Chain(Generic[Line]):
    """Lines put together end to end: the ``members`` by number, in their order, and the line that they are.

    ``head`` and ``tail`` are the ends that it starts and stops with.
    """

    line: Line
    members: tuple[int, ...]
    head: LineEnd
    tail: LineEnd


def chain_lines(
    lines: Sequence[Line],
    links: Iterable[tuple[LineEnd, LineEnd]],
    reverse: Callable[[Line], Line],
    join: Callable[[Line, Line, int], Line],
    close: Callable[[Line], Line | None],
) -> list[Chain[Line]]:
    """Put lines together along links, the first link first; a link to an end that is taken does nothing.

    Args:
        lines: of any type.
        links: pairs of ends that are one place.
        reverse: gives a line run the other way.
        join: gives the line of two, the second going on where the first stops; the third argument is the number of
            the link.
        close: gives a line led back to its start, or None to leave it open.

    Returns:
        The chains; a chain keeps the place and the direction of the line that its links named first.
    """
    chains = {number: Chain(line, (number,), (number, 0), (number, -1)) for number, line in enumerate(lines)}
    chain_of = {end: number for number in chains for end in ((number, 0), (number, -1))}
    for number, (first, second) in enumerate(links):
        if first not in chain_of or second not in chain_of:
            continue
        kept, dropped = chain_of[first], chain_of[second]
        if kept == dropped:
            closed = close(chains[kept].line)
            if closed is None:
                continue
            chains[kept] = replace(chains[kept], line=closed)
        else:
            before, after = chains[kept], chains.pop(dropped)
            if before.tail != first:
                before = Chain(reverse(before.line), before.members[::-1], before.tail, before.head)
            if after.head != second:
                after = Chain(reverse(after.line), after.members[::-1], after.tail, after.head)
            line = join(before.line, after.line, number)
            chains[kept] = Chain(line, before.members + after.members, before.head, after.tail)
            chain_of[after.tail] = kept
        del chain_of[first], chain_of[second]
    return [chains[number] for number in sorted(chains)]
