"""Frame maps of the shipped network in the towns of the demo world, and the truth there."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import shapely

from mapfusion.elements import FrameMap, GlobalMap
from predmapnet.demo_world.source import DemoSource
from predmapnet.evaluation.global_map import seen_area
from predmapnet.frame_files.parquet import read_frames
from predmapnet.mapper import Mapper
from predmapnet.runs.infer import MappingPipeline
from predmapnet.runs.outputs import Outputs
from predmapnet.weights.files import weights_hash


@dataclass(frozen=True)
class MappedTown:
    """One scene: what was seen in each frame, the true map, and the area that was seen."""

    name: str
    frames: tuple[FrameMap, ...]
    truth: GlobalMap
    seen: shapely.Geometry


def mapped_towns(folder: Path, split: str) -> Iterator[MappedTown]:
    """Yield the scenes of a split; frames are read from a folder, or mapped and written there.

    The files are named after the scene and the weights, ``SCENE-HASH.parquet``: other weights map anew. Delete them
    when the mapper itself has changed.
    """
    source = DemoSource()
    weights = weights_hash()[:12]
    pipeline: MappingPipeline | None = None
    folder.mkdir(parents=True, exist_ok=True)
    for info in source.scenes(split):
        path = folder / f"{info.name}-{weights}.parquet"
        if not path.is_file():
            pipeline = pipeline or MappingPipeline(source, Mapper.from_checkpoint())
            pipeline.run(info.name, Outputs(frames=path))
        frames = tuple(frame.frame_map for frame in read_frames(path).frames)
        truth = source.open(info.name).truth_map()
        assert truth is not None
        seen = seen_area([frame.ego_to_global for frame in frames], frames[0].roi)
        yield MappedTown(info.name, frames, truth, seen)
