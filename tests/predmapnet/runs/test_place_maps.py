"""Global mAP across scenes: one map per location, counted by hand."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from mapfusion.elements import ElementKind, FrameMap, GlobalMap, MapElement, RegionOfInterest
from predmapnet.evaluation.frames import EvaluationFrame
from predmapnet.evaluation.measurement import measure_scene, pool_scenes
from predmapnet.runs.integrate import with_own_ids
from predmapnet.runs.place_maps import place_matches
from predmapnet.scenes import FrameTruth, SceneInfo

ROI = RegionOfInterest()
NOTHING = np.zeros(0, dtype=np.int64)
ROAD = np.array([[-500.0, 4.0], [500.0, 4.0]])


def divider(start, end, y=4.0, confidence=0.9):
    points = np.stack([np.linspace(start, end, 40), np.full(40, y)], axis=1)
    return MapElement(ElementKind.DIVIDER, points, confidence, 10, 0, 9)


@dataclass
class Roads:
    """A source whose every location is a straight road with one divider at y = 4 m."""

    locations: dict
    known: bool = True

    def scenes(self):
        return tuple(SceneInfo(name, "test", 3, place) for name, place in self.locations.items())

    def truth_map(self, scenes, roi):
        assert len({self.locations[name] for name in scenes}) == 1 and roi == ROI
        return GlobalMap((MapElement(ElementKind.DIVIDER, ROAD, 1.0, 1, 0, 1),)) if self.known else None


def drive(name, start, *elements):
    """A scene of three frames from x = ``start`` on, which sees ``start - 30`` to ``start + 50``, and its map."""
    frames = []
    for index in range(3):
        pose = np.eye(4)
        pose[0, 3] = start + 10.0 * index
        found = FrameMap(index, pose, ROI, NOTHING, np.zeros(0), NOTHING, ())
        frames.append(EvaluationFrame(name, index, found, FrameTruth(NOTHING, (), NOTHING)))
    truth = GlobalMap((MapElement(ElementKind.DIVIDER, ROAD, 1.0, 1, 0, 1),))
    found = GlobalMap(elements)
    return replace(measure_scene(frames, found, truth), maps=(found, truth))


def across(source, *scenes):
    result = pool_scenes(scenes, place_matches(source, scenes))
    return result.place_map_ap.kinds[ElementKind.DIVIDER], result


def test_overlapping_scenes_are_one_map_against_one_truth():
    """Two drives see -30 to 50 m and 20 to 100 m: one true line of 130 m, found by one line, not two of each."""
    scenes = drive("a", 0.0, divider(-30, 50)), drive("b", 50.0, divider(20, 100))
    found, total = across(Roads({"a": "here", "b": "here"}), *scenes)
    assert (found.truths, found.predictions) == (1, 1)
    assert found.average_precision == pytest.approx(1.0)
    single = total.global_map_ap.kinds[ElementKind.DIVIDER]
    assert (single.truths, single.predictions) == (2, 2)
    figures = total.figures()["place_map_ap"]
    assert figures["places"] == 1 and figures["mAP"] == pytest.approx(1 / 3)


def test_half_of_a_place_is_not_its_line():
    """The second drive found nothing: 80 m of the 130 m line are 12 m of chamfer distance away from the whole."""
    found, total = across(Roads({"a": "here", "b": "here"}), drive("a", 0.0, divider(-30, 50)), drive("b", 50.0))
    assert (found.truths, found.predictions, found.average_precision) == (1, 1, 0.0)
    assert total.global_map_ap.kinds[ElementKind.DIVIDER].average_precision == pytest.approx(0.5)


def test_what_one_scene_maps_twice_is_a_false_positive_in_the_map_of_both():
    """The second drive has the line once more, 5 m aside and surer: precision 1/2 where the recall is reached."""
    kerbs = [replace(divider(-30, 50, y), kind=ElementKind.BOUNDARY) for y in (-7.0, 13.0)]
    once = drive("a", 0.0, *kerbs, divider(-30, 50, confidence=0.6))
    twice = drive("b", 0.0, *kerbs, divider(-30, 50, confidence=0.6), divider(-30, 50, 9.0, 0.95))
    found, _ = across(Roads({"a": "here", "b": "here"}), once, twice)
    assert (found.truths, found.predictions) == (1, 2)
    assert found.average_precision == pytest.approx(0.5)


def test_places_are_matched_one_by_one_and_ranked_together():
    """Right at 0.8 in one place, wrong at 0.95 in the other: 1/2 of the truth at a precision of 1/2."""
    scenes = drive("a", 0.0, divider(-30, 50, confidence=0.8)), drive("b", 0.0, divider(-30, 50, 9.0, 0.95))
    found, total = across(Roads({"a": "here", "b": "there"}), *scenes)
    assert found.average_precision == pytest.approx(0.25)
    assert total.figures()["place_map_ap"]["places"] == 2


def test_a_place_without_any_prediction_is_missed():
    scenes = [drive("a", 0.0, divider(-30, 50)), drive("b", 0.0), drive("c", 50.0)]
    found, _ = across(Roads({"a": "here", "b": "there", "c": "there"}), *scenes)
    assert (found.truths, found.predictions) == (2, 1)
    assert found.average_precision == pytest.approx(0.5)


def test_scenes_whose_location_is_not_known_are_never_one_place():
    scenes = drive("a", 0.0, divider(-30, 50)), drive("b", 0.0, divider(-30, 50))
    found, total = across(Roads({"a": "", "b": ""}), *scenes)
    assert found.truths == 2 and total.figures()["place_map_ap"]["places"] == 2


def test_without_the_truth_of_a_place_there_is_no_figure():
    scenes = [drive("a", 0.0, divider(-30, 50)), drive("b", 0.0, divider(-30, 50))]
    assert place_matches(Roads({"a": "here", "b": "here"}, known=False), scenes) is None
    bare = [replace(scene, maps=None, global_matches=None) for scene in scenes]
    assert place_matches(Roads({"a": "here", "b": "there"}), bare) is None
    assert pool_scenes(bare).figures()["place_map_ap"] is None


def test_elements_without_ids_get_one_each_from_the_score_on():
    """Ids differ over all frames, so that elements meet by where they lie; weaker ones take no part."""
    lines = (np.zeros((2, 2)),) * 3
    scores = (np.array([0.4, 0.39, 0.9]), np.array([0.2, 0.8, 0.4]))
    frames = [FrameMap(0, np.eye(4), ROI, np.ones(3, int), each, np.full(3, -1), lines) for each in scores]
    ids = [frame.track_ids.tolist() for frame in with_own_ids(frames)]
    assert [[number >= 0 for number in own] for own in ids] == [[True, False, True], [False, True, True]]
    kept = [number for own in ids for number in own if number >= 0]
    assert len(set(kept)) == len(kept) == 4
