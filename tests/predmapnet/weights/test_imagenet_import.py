"""ImageNet's ResNet-50 under the names of four libraries."""

import re

import pytest
import torch
import torch.nn.functional as F

from predmapnet.errors import UserError
from predmapnet.presets import preset
from predmapnet.weights.imagenet_import import RESNET, backbone_name, import_imagenet_backbone, is_imagenet_backbone

DEPTHS = (3, 4, 6, 3)


def torchvision_state(scale: float = 0.1) -> dict[str, torch.Tensor]:
    """A ResNet-50's state dict under torchvision's names, at random."""
    generator = torch.Generator().manual_seed(3)
    state = {}

    def unit(convolution: str, norm: str, out: int, channels: int, kernel: int) -> None:
        state[f"{convolution}.weight"] = scale * torch.randn(out, channels, kernel, kernel, generator=generator)
        for value in ("weight", "bias", "running_mean", "running_var"):
            state[f"{norm}.{value}"] = torch.rand(out, generator=generator) + 0.5
        state[f"{norm}.num_batches_tracked"] = torch.tensor(7)

    unit("conv1", "bn1", 64, 3, 7)
    channels = 64
    for stage, blocks in enumerate(DEPTHS):
        width = 64 * 2**stage
        for block in range(blocks):
            prefix = f"layer{stage + 1}.{block}"
            unit(f"{prefix}.conv1", f"{prefix}.bn1", width, channels, 1)
            unit(f"{prefix}.conv2", f"{prefix}.bn2", width, width, 3)
            unit(f"{prefix}.conv3", f"{prefix}.bn3", 4 * width, width, 1)
            if block == 0:
                unit(f"{prefix}.downsample.0", f"{prefix}.downsample.1", 4 * width, channels, 1)
            channels = 4 * width
    state["fc.weight"], state["fc.bias"] = torch.zeros(1000, 2048), torch.zeros(1000)
    return state


def detectron2_name(name: str) -> str:
    """torchvision's name as Detectron2 has it."""
    unit, value = name.rsplit(".", 1)
    unit = re.sub(r"^(conv1|bn1)$", r"stem.\1", unit)
    unit = re.sub(r"layer(\d)", lambda found: f"res{int(found[1]) + 1}", unit)
    unit = unit.replace("downsample.0", "shortcut").replace("downsample.1", "shortcut.norm")
    return re.sub(r"bn(\d)", r"conv\1.norm", unit) + f".{value}"


def detectron_name(name: str) -> str:
    """torchvision's name as Detectron has it."""
    unit, value = name.rsplit(".", 1)
    norm = "bn" in unit or "downsample.1" in unit
    ending = {"weight": "s", "bias": "b", "running_mean": "rm", "running_var": "riv"}[value] if norm else "w"
    if unit in ("conv1", "bn1"):
        return f"{'res_' if norm else ''}conv1{'_bn' if norm else ''}_{ending}"
    stage, block, part = re.match(r"layer(\d)\.(\d+)\.(?:conv|bn)?(\d|downsample)", unit).groups()
    branch = "branch1" if part == "downsample" else f"branch2{'abc'[int(part) - 1]}"
    return f"res{int(stage) + 1}_{block}_{branch}{'_bn' if norm else ''}_{ending}"


@pytest.fixture(scope="module")
def state():
    return torchvision_state()


@pytest.fixture(scope="module")
def imported(state):
    return import_imagenet_backbone(state, preset("paper-nuscenes"))


def test_every_entry_but_the_classifier_goes_into_the_backbone(state, imported):
    network, report = imported
    assert report.ignored == ["fc.weight", "fc.bias"]
    there = network.state_dict()
    first = f"{RESNET}stem.convolution.weight"
    for name, here in report.mapped.items():
        assert here == first or torch.equal(state[name], there[here])
    filled = {name for name in there if name.startswith(RESNET)} - set(report.mapped.values())
    assert all(".offsets." in name for name in filled)
    assert all(not there[name].any() for name in filled), "deformable kernels begin as plain ones"
    assert report.fresh and not any(name.startswith(RESNET) for name in report.fresh)


@pytest.mark.parametrize("renamed", [detectron2_name, detectron_name])
def test_other_libraries_names_mean_the_same(state, renamed):
    for name in state:
        if not name.startswith("fc.") and "num_batches" not in name:
            assert backbone_name(name) is not None
            assert backbone_name(renamed(name)) == backbone_name(name)
    assert is_imagenet_backbone(
        {renamed(name): value for name, value in state.items() if "num_" not in name and "fc" not in name}
    )


def test_torchvisions_first_kernel_sees_the_same_image(state, imported):
    """A picture as torchvision normalises it, and as the network takes it."""
    network, report = imported
    assert report.converted
    picture = torch.rand(1, 3, 32, 32)
    mean, deviation = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    normalised = (picture - mean.view(3, 1, 1)) / deviation.view(3, 1, 1)
    there = F.conv2d(normalised, state["conv1.weight"], stride=2, padding=3)
    bgr_bytes = 255 * picture.flip(1) - torch.tensor(network.config.image.mean).view(3, 1, 1)
    here = F.conv2d(bgr_bytes, network.image_backbone.resnet.stem.convolution.weight, stride=2, padding=3)
    assert torch.allclose(there, here, atol=1e-4)


def test_caffes_kernel_is_taken_as_it_is():
    state = torchvision_state(scale=0.002)
    network, report = import_imagenet_backbone(state, preset("paper-nuscenes"))
    assert not report.converted
    assert torch.equal(network.image_backbone.resnet.stem.convolution.weight, state["conv1.weight"])


def test_what_is_no_resnet_50_is_refused(state):
    with pytest.raises(UserError, match=r"missing: .*expand"):
        import_imagenet_backbone(
            {name: v for name, v in state.items() if "layer4.2.conv3" not in name}, preset("paper-av2")
        )
    with pytest.raises(UserError, match="not known: layer9"):
        import_imagenet_backbone({**state, "layer9.weight": torch.zeros(1)}, preset("paper-nuscenes"))
    with pytest.raises(UserError, match="not of a ResNet-50's shape: layer1"):
        import_imagenet_backbone({**state, "layer1.0.conv2.weight": torch.zeros(64, 4, 3, 3)}, preset("paper-nuscenes"))
    with pytest.raises(UserError, match="lite has no ResNet"):
        import_imagenet_backbone(state, preset("lite"))
