"""The choice of maps that add most: near the best of all, new ground first, then what few frames saw."""

from itertools import combinations, pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapfusion import ElementKind, GlobalMap, MapElement, MergeConfig, merge_maps
from mapfusion.ground import coverage
from mapfusion.merge.choice import CELL, EVIDENCE, KNOWN_FRAMES, LookedAt, choose, looked_at

NAMES = tuple("abcdefg")


def road(start: float, end: float, frames: int, y: float = 0.0) -> GlobalMap:
    x = np.arange(start, end + 0.1, 10.0)
    kerbs = (np.stack([x, np.full(len(x), y + side)], axis=1) for side in (-5.0, 5.0))
    return GlobalMap(tuple(MapElement(ElementKind.BOUNDARY, kerb, 0.9, frames, 0, 1) for kerb in kerbs))


def chosen(maps: dict[str, GlobalMap], most: int):
    return choose(list(maps), [looked_at(found, coverage(found)) for found in maps.values()], most)


def known(looked: list[LookedAt]) -> float:
    """What maps know together, square metres; written anew here, cell by cell."""
    frames: dict[tuple[int, int], float] = {}
    for one in looked:
        for cell, count in zip(one.cells.tolist(), one.frames.tolist(), strict=True):
            frames[tuple(cell)] = frames.get(tuple(cell), 0.0) + count
    return CELL**2 * sum(1.0 + EVIDENCE * (1.0 - np.exp(-count / KNOWN_FRAMES)) for count in frames.values())


grounds = st.lists(
    st.dictionaries(st.tuples(st.integers(-2, 3), st.integers(-2, 2)), st.integers(1, 9), max_size=12),
    min_size=1,
    max_size=len(NAMES),
).map(
    lambda found: [
        LookedAt(np.array(list(one)).reshape(-1, 2).astype(np.int64), np.array(list(one.values()), dtype=float))
        for one in found
    ]
)


@settings(deadline=None)
@given(grounds, st.integers(1, 6))
def test_a_choice_knows_nearly_as_much_as_any_other_of_as_many(looked, most):
    found = choose(NAMES[: len(looked)], looked, most)
    assert sorted(one.name for one in found) == sorted(NAMES[: len(looked)])
    taken = [NAMES.index(one.name) for one in found if one.taken]
    assert len(taken) == min(most, len(looked))
    own = known([looked[place] for place in taken])
    best = max(known([looked[place] for place in some]) for some in combinations(range(len(looked)), len(taken)))
    assert own >= (1.0 - 1.0 / np.e) * best - 1e-6
    assert sum(one.adds for one in found if one.taken) == pytest.approx(own)


@settings(deadline=None)
@given(grounds)
def test_more_maps_are_the_same_ones_and_others_and_each_adds_less(looked):
    names = NAMES[: len(looked)]
    order = choose(names, looked, len(looked))
    for most in range(1, len(looked)):
        found = choose(names, looked, most)
        assert found[:most] == order[:most]
        left = [one.adds for one in found[most:]]
        assert left == sorted(left, reverse=True)
        assert max(left) <= found[most - 1].adds + 1e-6
    assert all(later.adds <= earlier.adds + 1e-6 for earlier, later in pairwise(order))


def test_new_ground_comes_before_more_evidence():
    found = chosen({"often": road(0, 400, 30), "again": road(0, 400, 30), "elsewhere": road(400, 500, 2, 200.0)}, 2)
    assert [one.name for one in found] == ["often", "elsewhere", "again"]
    assert [one.taken for one in found] == [True, True, False]
    assert found[0].new_ground == pytest.approx(400.0 * 22.0, rel=0.15)  # the kerbs, 8 m beside them, less the rim
    assert found[1].new_ground == pytest.approx(100.0 * 22.0, rel=0.25)
    assert found[2].new_ground == 0.0


def test_of_known_ground_the_weak_one_is_driven_again():
    maps = {"well": road(0, 300, 60), "once": road(0, 300, 4, 200.0), "well2": road(0, 300, 9)}
    found = chosen(maps | {"once2": road(0, 300, 3, 200.0)}, 3)
    assert [one.name for one in found if one.taken] == ["well", "once", "once2"]
    assert found[-1].name == "well2"
    assert looked_at(GlobalMap(()), coverage(GlobalMap(()))).cells.shape == (0, 2)


def test_a_merge_of_some_is_the_merge_of_those_alone_in_any_order():
    maps = {"a": road(0, 300, 30), "b": road(0, 295, 20), "c": road(250, 500, 3), "copy": road(0, 295, 20)}
    config = MergeConfig(at_most=2)
    merged, report = merge_maps(list(maps.values()), list(maps), config)
    alone, _ = merge_maps([maps["a"], maps["c"]], ["a", "c"])
    assert merged.provenance["sources"] == ["a", "c"]
    assert [(e.kind, e.observations, e.points.tobytes()) for e in merged] == [
        (e.kind, e.observations, e.points.tobytes()) for e in alone
    ]
    assert [one.name for one in report.choice] == ["a", "c", "b"]
    assert [status.name for status in report.maps] == ["a", "c"]
    assert report.duplicates == ()
    turned, again = merge_maps(list(maps.values())[::-1], list(maps)[::-1], config)
    assert {one.name for one in again.choice if one.taken} == {"a", "c"}
    assert sum(e.length for e in turned) == pytest.approx(sum(e.length for e in merged))
    assert merge_maps(list(maps.values()), list(maps), MergeConfig(at_most=3))[1].choice == ()
