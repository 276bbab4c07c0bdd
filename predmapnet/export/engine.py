"""Mapping with exported graphs, in ONNX Runtime."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from predmapnet.engines import CALIBRATIONS_KEPT, EngineStep
from predmapnet.errors import UserError
from predmapnet.export.graphs import BEV_MEMORY, DETECTIONS, BevToMap, geometry_tensors, padded_state
from predmapnet.export.onnx_files import BEV_TO_MAP, IMAGE_TO_BEV, GraphFolder, export_graphs, read_graph_folder
from predmapnet.machine import EngineKind, NetworkOptions, Precision
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.network.state import FrameInputs, Instances, Selection, StreamState
from predmapnet.weights.checkpoint import load_checkpoint

Arrays = dict[str, np.ndarray[Any, Any]]


class OnnxEngine:
    """The two graphs of a folder; computes what :class:`~predmapnet.engines.TorchEngine` computes.

    The geometry of a rig is found by torch, once; a frame is two calls of the runtime.

    Args:
        graphs: as exported.
        threads: of the runtime; 0 for all cores.
    """

    kind = EngineKind.ONNX
    device = torch.device("cpu")

    def __init__(self, graphs: GraphFolder, threads: int = 0) -> None:
        self.graphs, self.config = graphs, graphs.config
        self._images, self._map = (_session(graphs.folder / name, threads) for name in (IMAGE_TO_BEV, BEV_TO_MAP))
        self._image_inputs = {wanted.name for wanted in self._images.get_inputs()}
        # Without weights: it knows the cameras' geometry and how a stream begins.
        self._network = PredMapNet(graphs.config).eval()
        self._start = padded_state(self._network, graphs.rows)
        self._decoder = BevToMap(self._network, self._start)
        self._geometries: dict[bytes, Arrays] = {}

    @classmethod
    def open(cls, options: NetworkOptions) -> OnnxEngine:
        """Open a folder of graphs, or export a checkpoint for this run.

        Raises:
            UserError: there are no such graphs, or the extra is missing; or the options ask for what ONNX has not.
        """
        if options.precision is not Precision.FLOAT32 or options.compiled or options.device not in ("auto", "cpu"):
            raise UserError("The onnx engine computes in float32 on the CPU, without --compile.")
        if options.weights is not None and options.weights.is_dir():
            return cls(read_graph_folder(options.weights), torch.get_num_threads())
        with TemporaryDirectory() as folder:
            return cls(
                export_graphs(load_checkpoint(options.weights), Path(folder) / "graphs"), torch.get_num_threads()
            )

    def features(self, inputs: FrameInputs) -> Arrays | None:
        """Compute BEV features where no BEV memory takes part in them; otherwise they are the step's."""
        if any(name.startswith("state.") for name in self._image_inputs):
            return None
        return self._bev_levels(inputs, {})

    def step(self, inputs: FrameInputs, state: StreamState | None, features: Arrays | None = None) -> EngineStep:
        """Map one frame, as :class:`~predmapnet.engines.Engine` says."""
        state = state or self._start
        tensors = {f"state.{name}": value.numpy() for name, value in state.tensors().items()}
        pose = inputs.ego_to_global.numpy()
        levels = features
        if levels is None:
            levels = self._bev_levels(inputs, {f"state.{name}": tensors[f"state.{name}"] for name in BEV_MEMORY})
        named = {name: tensors[f"state.{name}"] for name in self._decoder.names}
        found = _run(
            self._map,
            {**levels, "ego_to_global": pose, **{f"state.{name}": value for name, value in named.items()}},
        )
        outputs = {name: torch.from_numpy(value) for name, value in found.items()}
        following = self._decoder.state({name: outputs[f"next.{name}"] for name in self._decoder.names})
        return Selection(following.instances, _detections(outputs), following.lost), following, outputs["segmentation"]

    def _bev_levels(self, inputs: FrameInputs, memory: Arrays) -> Arrays:
        """Run the first graph on a frame and, where it takes part, the BEV memory."""
        given = {
            "images": np.ascontiguousarray(inputs.images.numpy()),
            "camera_valid": inputs.camera_valid.numpy(),
            "camera_code": inputs.calibration.camera_code.numpy(),
            "ego_to_global": inputs.ego_to_global.numpy(),
            **self._geometry(inputs),
            **memory,
        }
        return _run(self._images, {name: value for name, value in given.items() if name in self._image_inputs})

    def _geometry(self, inputs: FrameInputs) -> Arrays:
        """Return the geometry of a calibration, from the few that were used last."""
        key = inputs.calibration.fingerprint()
        arrays = self._geometries.pop(key, None)
        if arrays is None:
            geometry = self._network.view_geometry(inputs.calibration)
            arrays = {name: value.numpy() for name, value in geometry_tensors(geometry).items()}
        self._geometries[key] = arrays
        if len(self._geometries) > CALIBRATIONS_KEPT:
            self._geometries.pop(next(iter(self._geometries)), None)  # another thread may have been first
        return arrays


def _detections(outputs: dict[str, torch.Tensor]) -> Instances:
    valid, labels, scores, points = (outputs[f"detections.{name}"] for name in DETECTIONS)
    none = torch.full_like(labels, -1)
    empty = scores.new_zeros(*scores.shape, 0)
    return Instances(valid, none, labels, scores, torch.zeros_like(labels), empty, points, empty[..., None])


def _session(path: Path, threads: int) -> Any:
    try:
        import onnxruntime
    except ImportError:
        raise UserError("The onnx engine needs the extra 'onnx': pip install 'predmapnet[onnx]'.") from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # The runtime's errors have no common class but this.
        raise UserError(f"{path} cannot be run ({str(error).splitlines()[0]}). Export it again.") from None


def _run(session: Any, inputs: Arrays) -> Arrays:
    names = [output.name for output in session.get_outputs()]
    return dict(zip(names, session.run(names, inputs), strict=True))
