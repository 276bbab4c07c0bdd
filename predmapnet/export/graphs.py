"""One instant as two graphs, ready to be traced: images to BEV, and everything after it with the state in and out.

Shapes are fixed but for the cameras and for how many pixels see the ground: a stream has ``rows`` tracks, padded, and
full memories, whose entries say whether they are valid. Of a frame with more tracks the last ones end.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor, nn

from predmapnet.config import BevFormerConfig, EncoderBevMemoryConfig, PredMapNetConfig
from predmapnet.network.calibration import Calibration
from predmapnet.network.maptracker.reference_points import LEVEL_STRIDES, ReferencePoints
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.network.small.ground_lookup import GroundLookup, SparseRows
from predmapnet.network.state import (
    BevFeatures,
    FrameInputs,
    Instances,
    LostTracks,
    StreamState,
    VectorMemory,
    ViewGeometry,
)
from predmapnet.network.track_selection import select

LEVELS = ("bev.fine", "bev.middle", "bev.coarse")
DETECTIONS = ("valid", "labels", "scores", "points")
"""Of the rows that are reported beside the tracks."""
BEV_MEMORY = ("bev_memory", "bev_memory_pose", "bev_memory_valid")
"""Parts of the state that the images' graph reads where the BEV encoder has the memory."""


def padded_state(network: PredMapNet, rows: int) -> StreamState:
    """Return the state before the first frame of one stream, with ``rows`` padded tracks and full memories."""
    config, state = network.config, network.initial_state(1)

    def padded(values: Tensor, count: int = rows) -> Tensor:
        return values.new_zeros(1, count, *values.shape[2:])

    memory = config.bev.memory
    if isinstance(memory, EncoderBevMemoryConfig):
        poses = torch.eye(4, dtype=torch.float64).repeat(1, memory.capacity, 1, 1)
        maps, valid = padded(state.bev_memory, memory.capacity), padded(state.bev_memory_valid, memory.capacity)
        state = replace(state, bev_memory=maps, bev_memory_pose=poses, bev_memory_valid=valid)
    names = ("history_maps", "point_history", "point_history_valid", "forecasts")
    instances = Instances(**{name: padded(values) for name, values in vars(state.instances).items()})
    return replace(
        state,
        **{name: padded(getattr(state, name)) for name in names},
        instances=replace(instances, track_ids=instances.track_ids - 1),
        vector_memory=VectorMemory(**{name: padded(values) for name, values in vars(state.vector_memory).items()}),
        lost=_no_lost_tracks(state, config) if config.revival.enabled else None,
    )


def _no_lost_tracks(state: StreamState, config: PredMapNetConfig) -> LostTracks:
    capacity, histories = config.revival.capacity, config.future.histories
    pose = torch.eye(4, dtype=torch.float64)
    return LostTracks(
        valid=torch.zeros(1, capacity, dtype=torch.bool),
        track_ids=torch.full((1, capacity), -1),
        labels=torch.zeros(1, capacity, dtype=torch.int64),
        missing=torch.zeros(1, capacity, dtype=torch.int64),
        ego_to_global=pose.repeat(1, capacity, 1, 1),
        history_maps=state.history_maps.new_zeros(1, capacity, *state.history_maps.shape[2:]),
        point_history=state.point_history.new_zeros(1, capacity, *state.point_history.shape[2:]),
        point_history_valid=torch.zeros(1, capacity, histories, dtype=torch.bool),
        recent_poses=pose.repeat(1, histories, 1, 1),
    )


def geometry_tensors(geometry: ViewGeometry) -> dict[str, Tensor]:
    """Name the tensors of a geometry as the images' graph takes them."""
    if isinstance(geometry, GroundLookup):
        return {
            **{f"view.{name}": value for name, value in vars(geometry.gather).items()},
            "view.visible": geometry.visible,
        }
    return {f"view.{name}": getattr(geometry, name) for name in ("camera", "cell", "positions", "visible")}


class ImageToBev(nn.Module):
    """Images of one instant to BEV features.

    Inputs by name: ``images``, ``camera_valid``, the geometry of the cameras (:func:`geometry_tensors`), and for
    MapTracker's encoder ``camera_code``, ``ego_to_global`` and the BEV memory of the state.
    """

    def __init__(self, network: PredMapNet, start: StreamState) -> None:
        super().__init__()
        self.network = network
        self.start = start
        self.has_memory = isinstance(network.config.bev, BevFormerConfig)

    def forward(self, named: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return the levels by name."""
        inputs = FrameInputs(named["images"], named["camera_valid"], self.start.ego_to_global, Calibration.empty(1))
        state = self.start
        if self.has_memory:
            calibration = replace(inputs.calibration, camera_code=named["camera_code"])
            inputs = replace(inputs, ego_to_global=named["ego_to_global"], calibration=calibration)
            memory = {name: named[f"state.{name}"] for name in BEV_MEMORY}
            state = StreamState.from_tensors({**state.tensors(), **memory})
        features = self.network.encode_images(inputs)
        levels = self.network.encode_bev(features, inputs, state, self._geometry(named)).levels
        return dict(zip(LEVELS, levels, strict=False))

    def _geometry(self, named: Mapping[str, Tensor]) -> ViewGeometry:
        given = {name.removeprefix("view."): value for name, value in named.items() if name.startswith("view.")}
        if self.has_memory:
            height, width = named["images"].shape[-2:]
            sizes = tuple((-(-height // stride), -(-width // stride)) for stride in LEVEL_STRIDES)
            return ReferencePoints(**given, level_sizes=sizes)
        visible = given.pop("visible")
        return GroundLookup(SparseRows(**given), pixels=0, visible=visible)


class BevToMap(nn.Module):
    """BEV features and the state to the map of an instant and the next state.

    Inputs by name: the levels, ``ego_to_global``, and ``state.*``. Outputs: ``next.*`` of the same shapes,
    ``segmentation`` and ``detections.*``.
    """

    def __init__(self, network: PredMapNet, start: StreamState) -> None:
        super().__init__()
        self.network = network
        tensors = start.tensors()
        self.names = [name for name, value in tensors.items() if value.numel()]
        self.constant = {name: value for name, value in tensors.items() if not value.numel()}

    def forward(self, named: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return the outputs by name."""
        state = self.state({name: named[f"state.{name}"] for name in self.names})
        levels = [named[name] for name in LEVELS if name in named]
        nothing = levels[0].new_zeros(1, 0, 3, 1, 1)
        inputs = FrameInputs(nothing, nothing[..., 0, 0, 0].bool(), named["ego_to_global"], Calibration.empty(1))
        outputs = self.network.decode_bev(BevFeatures(levels), inputs, state)
        selection = select(outputs, state, self.network.config)
        following = self.network.advance(state, outputs, selection.instances, inputs, selection.lost).tensors()
        found = {f"detections.{name}": getattr(selection.detections, name) for name in DETECTIONS}
        return {
            "segmentation": outputs.segmentation,
            **found,
            **{f"next.{name}": following[name] for name in self.names},
        }

    def state(self, tensors: Mapping[str, Tensor]) -> StreamState:
        """Return a state of its tensors that are not empty."""
        return StreamState.from_tensors({**self.constant, **tensors})
