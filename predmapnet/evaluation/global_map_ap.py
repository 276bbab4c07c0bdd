"""Global mAP as GlobalMapNet reports it: chamfer AP of the elements of a map of a whole drive, or of several.

After GlobalMapNet (arXiv 2409.10063) and its public evaluation: the true map is cut by the union of the regions of
interest along the drive, every element is 200 points, and matching and averaging are those of chamfer AP. Maps are
matched one by one and ranked together: one map per scene gives the figure of single scenes, one map per place (see
:mod:`predmapnet.runs.place_maps`) the figure across scenes. Outlines of crossings are cut as lines, as there.
GlobalMapNet updates its map in every fourth frame and cuts by those; here all frames of a drive cut. The true map is
the one of :mod:`predmapnet.datasets.ground_truth.whole_map`, which joins dividers and merges crossings in its own way,
so figures are comparable with each other, but not with those in the paper.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely

from mapfusion.arrays import Float
from mapfusion.elements import GlobalMap
from predmapnet.evaluation.chamfer_ap import chamfer_matches
from predmapnet.evaluation.precision_recall import Matches


def global_map_matches(
    predicted: GlobalMap, truth: GlobalMap, seen: shapely.Geometry, thresholds: Sequence[float]
) -> Matches:
    """Match the elements of a global map to the true ones inside ``seen``; confidences are the scores.

    Both maps are in the same global frame; thresholds are chamfer distances, metres.
    """
    elements = tuple(predicted)
    kinds = np.array([element.kind for element in elements], dtype=np.int64)
    scores = np.array([element.confidence for element in elements], dtype=np.float64)
    pieces = [(element.kind, piece) for element in truth for piece in _inside(element.points, seen)]
    true_kinds = np.array([kind for kind, _ in pieces], dtype=np.int64)
    # Distances are differences of small numbers: far from the origin, float64 would lose digits.
    middle = np.array(seen.centroid.coords[0]) if not seen.is_empty else np.zeros(2)
    lines = [element.points - middle for element in elements]
    return chamfer_matches(kinds, scores, lines, true_kinds, [piece - middle for _, piece in pieces], thresholds)


def _inside(points: Float, seen: shapely.Geometry) -> list[Float]:
    if len(points) < 2:
        return []
    found = shapely.get_parts(shapely.intersection(shapely.LineString(points), seen))
    lines = [part for each in found for part in shapely.get_parts(each) if part.geom_type == "LineString"]
    return [shapely.get_coordinates(line) for line in lines]
