"""Import of ResNet-50 weights learned on ImageNet, as a network to train from.

Names of torchvision and mmcv (``layer1.0.conv1.weight``), of Detectron2 (``res2.0.conv1.weight``) and of Detectron
(``res2_0_branch2a_w``) are known. The network takes BGR bytes with the mean subtracted, as caffe's weights do;
torchvision's, which take normalised RGB, get their first kernel converted, which is exact. What stays different:
caffe's blocks halve in their first convolution, torchvision's in the second, so those weights have to adapt.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from predmapnet.config import BevFormerConfig, PredMapNetConfig
from predmapnet.errors import UserError
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.presets import PRESETS

RESNET = "image_backbone.resnet."
TORCHVISION_DEVIATION_BGR = (0.225, 0.224, 0.229)
"""By which torchvision divides blue, green and red in [0, 1]."""
LARGEST_CAFFE_KERNEL = 0.03
"""Root mean square of the first kernel: about 0.1 where inputs are normalised, about 0.002 where they are bytes."""

_PARTS = {"1": "reduce", "2": "spatial", "3": "expand", "a": "reduce", "b": "spatial", "c": "expand", "0": "shortcut"}
_NORM_VALUES = {"s": "weight", "b": "bias", "rm": "running_mean", "riv": "running_var"}
_VALUE = r"(?P<value>weight|bias|running_mean|running_var|num_batches_tracked)"
_TORCHVISION = re.compile(
    rf"(?:layer(?P<stage>[1-4])\.(?P<block>\d+)\.)?(?P<kind>conv|bn|downsample\.)(?P<part>\d)\.{_VALUE}"
)
_DETECTRON2 = re.compile(
    rf"(?:stem|res(?P<stage>[2-5])\.(?P<block>\d+))\.(?:conv(?P<part>\d)|shortcut)(?P<kind>\.norm)?\.{_VALUE}"
)
_DETECTRON = re.compile(
    r"(?:res(?P<stage>[2-5])_(?P<block>\d+)_branch(?:2(?P<part>[abc])|1)|(?:res_)?conv1)(?P<kind>_bn)?_"
    r"(?P<value>w|s|b|rm|riv)"
)


@dataclass(frozen=True)
class BackboneReport:
    """Report of the use of a file of ImageNet weights.

    Attributes:
        mapped: name in the file to name here.
        ignored: names of the classifier, which a detector does not need.
        fresh: names here that the file does not fill: initialised at random.
        converted: the first kernel was converted from normalised RGB.
    """

    mapped: dict[str, str]
    ignored: list[str]
    fresh: list[str]
    converted: bool

    def remarks(self) -> list[str]:
        """Say what was ignored, and which input the weights had learned."""
        lines = [f"{len(self.ignored)} ignored: the classifier"] if self.ignored else []
        if self.converted:
            lines.append("The first kernel was converted from normalised RGB to BGR bytes.")
        return lines


def is_imagenet_backbone(official: Mapping[str, Tensor]) -> bool:
    """Whether a state dict has a first ResNet block under one of the known names."""
    return any(backbone_name(name) == f"{RESNET}stages.0.0.reduce.convolution.weight" for name in official)


def import_imagenet_backbone(
    official: Mapping[str, Tensor], config: PredMapNetConfig, seed: int = 0
) -> tuple[PredMapNet, BackboneReport]:
    """Make a network whose image backbone begins from ImageNet and whose other parts begin at random.

    Args:
        official: names and tensors of a ResNet-50.
        config: of a network with a ResNet-50.
        seed: of the other parts.

    Raises:
        UserError: the configuration has another backbone; entries are unknown, missing or of another shape.
    """
    if not isinstance(config.bev, BevFormerConfig):
        known = ", ".join(name for name, found in PRESETS.items() if isinstance(found.bev, BevFormerConfig))
        raise UserError(f"{config.name} has no ResNet-50 to begin from ImageNet. Choose one of: {known}.")
    mapped, ignored, unknown = {}, [], []
    for name in official:
        here = backbone_name(name)
        if here is not None:
            mapped[name] = here
        elif name.startswith(("fc.", "fc1000_", "linear.", "pred_", "head.fc.")):
            ignored.append(name)
        else:
            unknown.append(name)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = PredMapNet(config).eval()
    wanted = network.state_dict()
    found = {here: official[name] for name, here in mapped.items()}
    optional = (".num_batches_tracked", ".offsets.weight", ".offsets.bias")
    lacking = [name for name in wanted if name.startswith(RESNET) and name not in found and not name.endswith(optional)]
    unfit = [name for name, here in mapped.items() if here not in wanted or wanted[here].shape != official[name].shape]
    faults = {"not known": unknown, "missing": lacking, "not of a ResNet-50's shape": unfit}
    if any(faults.values()):
        told = "; ".join(f"{what}: {', '.join(names[:4])}" for what, names in faults.items() if names)
        raise UserError(f"This is not a state dict of a ResNet-50 ({told}).")
    first = f"{RESNET}stem.convolution.weight"
    converted = bool(found[first].float().square().mean().sqrt() > LARGEST_CAFFE_KERNEL)
    if converted:
        found[first] = for_bgr_bytes(found[first])
    network.load_state_dict(found, strict=False)
    fresh = [name for name in wanted if name not in found and not name.endswith(optional)]
    return network, BackboneReport(mapped, ignored, fresh, converted)


def for_bgr_bytes(kernel: Tensor) -> Tensor:
    """Return a kernel ``(C, 3, k, k)`` of normalised RGB as one of BGR bytes with the mean subtracted."""
    return kernel.flip(1) / (255 * kernel.new_tensor(TORCHVISION_DEVIATION_BGR)).view(1, 3, 1, 1)


def backbone_name(official: str) -> str | None:
    """Return the name of a ResNet-50's entry here; None if it is none.

    Example:
        >>> backbone_name("layer1.0.downsample.1.bias")
        'image_backbone.resnet.stages.0.0.shortcut.norm.bias'
    """
    for pattern in (_TORCHVISION, _DETECTRON2, _DETECTRON):
        found = pattern.fullmatch(official)
        if found is None:
            continue
        stage, block, part, kind, value = (found[key] for key in ("stage", "block", "part", "kind", "value"))
        if pattern is _TORCHVISION:
            shortcut = kind == "downsample."
            norm = part == "1" if shortcut else kind == "bn"
            part, first_stage = ("0" if shortcut else part), 1
        else:
            norm, part, first_stage = kind is not None, part or "0", 2
        if pattern is _DETECTRON:
            value = _NORM_VALUES[value] if norm else "weight"
        unit = "stem" if stage is None else f"stages.{int(stage) - first_stage}.{block}.{_PARTS[part]}"
        return f"{RESNET}{unit}.{'norm' if norm else 'convolution'}.{value}"
    return None
