"""Vectorised ground truth exactly as the field's official code forms it, from the data sets' own maps."""

from predmapnet.datasets.ground_truth.nuscenes import NuScenesGroundTruth, truth_from_vector_map

__all__ = ["NuScenesGroundTruth", "truth_from_vector_map"]
