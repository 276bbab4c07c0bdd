"""A checkpoint of an untrained network that is sure of what it finds; few queries keep it fast."""

from pathlib import Path

import torch

from predmapnet.network.predmapnet import PredMapNet
from predmapnet.presets import preset
from predmapnet.weights.checkpoint import save_checkpoint


def write_random_weights(path: Path) -> Path:
    """Write the checkpoint."""
    torch.manual_seed(7)
    config = preset("lite")
    tracking = config.tracking.model_copy(update={"tau_d": 0.001, "tau_t": 0.001, "merge": False})
    decoder = config.decoder.model_copy(update={"queries": 6})
    network = PredMapNet(config.model_copy(update={"tracking": tracking, "decoder": decoder}))
    for name, parameter in network.map_decoder.named_parameters():
        if name.endswith("classify.bias"):
            torch.nn.init.constant_(parameter, 2.0)  # Lines of low scores are no evidence for a map.
    save_checkpoint(path, network)
    return path
