"""Global maps across scenes: one map per location, fused of the maps of its scenes, against the truth of them all."""

from __future__ import annotations

from collections.abc import Sequence

import shapely

from mapfusion.merge.merge import merge_maps
from predmapnet.errors import UserError
from predmapnet.evaluation.global_map import seen_area
from predmapnet.evaluation.global_map_ap import global_map_matches
from predmapnet.evaluation.measurement import SceneMeasurement
from predmapnet.evaluation.precision_recall import Matches
from predmapnet.scenes import SceneSource


def place_matches(source: SceneSource, scenes: Sequence[SceneMeasurement]) -> list[Matches] | None:
    """Match one map per location, in the order in which locations first appear.

    Scenes without a known location are places of their own. None where a scene has no map or no true one.

    Raises:
        UserError: the maps of a location lie too far apart to be one.
    """
    location = {info.name: info.location or info.name for info in source.scenes()}
    places: dict[str, list[SceneMeasurement]] = {}
    for scene in scenes:
        places.setdefault(location[scene.name], []).append(scene)
    matches = [_matches(source, place, group) for place, group in places.items()]
    found = [match for match in matches if match is not None]
    return found if len(found) == len(matches) else None


def _matches(source: SceneSource, place: str, scenes: Sequence[SceneMeasurement]) -> Matches | None:
    if len(scenes) == 1:
        return scenes[0].global_matches
    maps = [scene.maps[0] for scene in scenes if scene.maps is not None]
    names = [scene.name for scene in scenes]
    roi = scenes[0].frames[0].predicted.roi
    truth = source.truth_map(names, roi) if len(maps) == len(scenes) else None
    if truth is None:
        return None
    try:
        merged, _ = merge_maps(maps, names)
    except ValueError as error:
        raise UserError(f"The maps of the {len(scenes)} scenes of {place} cannot be merged: {error}") from error
    areas = [seen_area([frame.predicted.ego_to_global for frame in scene.frames], roi) for scene in scenes]
    return global_map_matches(merged, truth, shapely.union_all(areas), scenes[0].thresholds)
