"""Compilation of the image backbone and the BEV encoder by torch, which fuses what lies between the products."""

from __future__ import annotations

import os
import shutil

from torch.utils._triton import has_triton

from predmapnet.errors import UserError
from predmapnet.network.predmapnet import PredMapNet


def compile_features(network: PredMapNet) -> None:
    """Let the image backbone and the BEV encoder be compiled in the first frame; the network is changed in place.

    Raises UserError where there is no compiler for the network's device.
    """
    if network.device.type == "cuda":
        if not has_triton():
            raise UserError("To compile for this GPU, Triton is needed, and it is not installed. Leave out --compile.")
    elif shutil.which(os.environ.get("CXX", "g++")) is None:
        raise UserError("To compile, a C++ compiler is needed (g++, or what CXX names). Leave out --compile.")
    network.image_backbone.compile()
    network.bev_encoder.compile()
