"""MapTracker's checkpoints: every entry is explained, what does not fit is refused, nothing is executed."""

import math
import pickle
import zipfile
from pathlib import Path

import pytest
import torch

from mapfusion.elements import RegionOfInterest
from predmapnet.errors import UserError
from predmapnet.presets import preset
from predmapnet.weights.checkpoint import load_checkpoint, save_checkpoint
from predmapnet.weights.inspection import inspect_file, parts_of
from predmapnet.weights.maptracker_import import (
    import_maptracker,
    read_official_checkpoint,
)
from predmapnet.weights.maptracker_names import RULES, name_here
from tests.predmapnet.network.maptracker_reference import FOLDER, load_reference


@pytest.fixture(scope="module")
def official():
    if not (FOLDER / "state_dict_keys.json").is_file():
        pytest.skip(f"no reference fixtures in {FOLDER}: set PREDMAPNET_REFERENCE")
    return load_reference().official_state


@pytest.fixture
def changed(official):
    return dict(official)


@pytest.mark.reference
def test_every_entry_is_mapped_or_ignored_with_a_reason(official):
    network, report = import_maptracker(official)
    assert report.mapped.keys() | report.ignored.keys() == official.keys()
    assert sorted(report.mapped.values()) == sorted(network.state_dict())
    assert not report.missing
    shared = [entry["name"] for entry in load_reference().entries if entry["alias_of"]]
    assert set(report.ignored) == {*shared, "plane", "head.roi_size", "head.origin"}
    for name, here in report.mapped.items():
        assert torch.equal(official[name], network.state_dict()[here])
    assert not network.training


@pytest.mark.reference
def test_a_checkpoint_of_mmcv_comes_back_from_safetensors(official, tmp_path):
    path, out = tmp_path / "maptracker.pth", tmp_path / "weights.safetensors"
    torch.save({"meta": {"epoch": 48, "iter": 1}, "state_dict": official, "optimizer": {"state": {}}}, path)
    network, _ = import_maptracker(read_official_checkpoint(path))
    save_checkpoint(out, network, {"imported_from": path.name})
    again = load_checkpoint(out).network
    assert again.config == network.config
    for name, tensor in network.state_dict().items():
        assert torch.equal(again.state_dict()[name], tensor)
    info = inspect_file(out)
    assert info.about["facts"] == {"imported_from": "maptracker.pth"}
    assert sum(info.parts().values()) == sum(tensor.numel() for tensor in network.state_dict().values())


@pytest.mark.reference
def test_old_names_and_parallel_training_and_absent_counters(changed):
    old = {
        f"module.{name.replace('conv2.conv_offset', 'conv2_offset')}": tensor
        for name, tensor in changed.items()
        if not name.endswith("num_batches_tracked")
    }
    _, report = import_maptracker({name.removeprefix("module."): tensor for name, tensor in old.items()})
    assert report.missing
    assert all(name.endswith("num_batches_tracked") for name in report.missing)


@pytest.mark.reference
def test_seven_cameras_are_argoverse(changed):
    changed["backbone.transformer.cams_embeds"] = torch.zeros(7, 256)
    network, _ = import_maptracker(changed)
    assert network.config == preset("maptracker-av2") and len(network.config.bev.cameras) == 7


@pytest.mark.reference
def test_the_region_is_the_one_of_the_file(changed):
    changed["head.roi_size"], changed["head.origin"] = torch.tensor([100.0, 50.0]), torch.tensor([-50.0, -25.0])
    with pytest.raises(UserError, match="plane is not what a region of 100 m x 50 m needs"):
        import_maptracker(changed)
    changed["plane"] = changed["plane"] * torch.tensor([100 / 60, 50 / 30, 1.0, 1.0], dtype=torch.float64)
    network, _ = import_maptracker(changed)
    assert network.config.roi == RegionOfInterest(100.0, 50.0)


@pytest.mark.reference
def test_weights_under_the_modules_of_the_paper(official, tmp_path):
    network, report = import_maptracker(official, preset("paper-nuscenes"), seed=3)
    state = network.state_dict()
    assert network.config == preset("paper-nuscenes") and not network.training
    for name, here in report.mapped.items():
        assert torch.equal(official[name], state[here])
    assert sorted([*report.mapped.values(), *report.fresh]) == sorted(state)
    modules = {"query_generator", "mask_head", "history_guidance", "future_guidance", "bev_pyramid", "depth_head"}
    assert set(parts_of(report.fresh)) == modules
    assert not {"query_generator.content", "query_generator.first_guess.0.weight"} & set(report.fresh)
    # What guides the tracks begins as nothing, so that they start as MapTracker's.
    for name in ("future_guidance.fusion", "history_guidance.cross_attention.output"):
        assert not state[f"{name}.weight"].any() and not state[f"{name}.bias"].any()
    path = tmp_path / "paper.safetensors"
    save_checkpoint(path, network)
    again, _ = import_maptracker(official, preset("paper-nuscenes"), seed=3)
    for name, tensor in load_checkpoint(path).network.state_dict().items():
        assert torch.equal(again.state_dict()[name], tensor)


@pytest.mark.reference
@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("paper-av2", r"knows 6 cameras, but paper-av2 has 7 \(ring_front_center"),
        ("lite", "lite is not built on MapTracker's network.* Choose one of: .*paper-nuscenes"),
    ],
)
def test_a_configuration_that_cannot_take_the_weights_is_refused(official, name, says):
    with pytest.raises(UserError, match=says):
        import_maptracker(official, preset(name))


@pytest.mark.reference
@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("head.query_embedding.weight", None, "1 missing: query_generator.content"),
        (
            "head.query_embedding.weight",
            torch.zeros(50, 512),
            r"query_generator.content \(50, 512\) instead of \(100, 512\)",
        ),
        ("head.something_new", torch.zeros(3), "1 unknown: head.something_new"),
        ("head.cls_branches.3.bias", torch.zeros(3), "head.cls_branches.3.bias differs from head.cls_branches.0.bias"),
        ("head.origin", torch.tensor([-50.0, -25.0]), "head.origin is not what a region of 60 m x 30 m needs"),
    ],
)
def test_what_does_not_fit_is_refused(changed, name, value, says):
    if value is None:
        del changed[name]
    else:
        changed[name] = value
    with pytest.raises(UserError, match=says):
        import_maptracker(changed)


@pytest.mark.reference
def test_a_broken_file_is_not_answered_with_a_list_of_all_its_names(changed):
    broken = {name: value * math.nan if value.is_floating_point() else value for name, value in changed.items()}
    with pytest.raises(
        UserError, match=r"60 of a branch that all layers share are not the same: head\S+ differs"
    ) as caught:
        import_maptracker(broken)
    assert len(str(caught.value)) < 1000


class Malicious:
    """Touches a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_nothing_in_a_checkpoint_is_executed(tmp_path):
    touched, zipped, bare = tmp_path / "touched", tmp_path / "zipped.pth", tmp_path / "bare.pth"
    torch.save({"state_dict": {"plane": torch.zeros(1)}, "meta": Malicious(touched)}, zipped)
    bare.write_bytes(pickle.dumps(Malicious(touched), protocol=2))
    for path in (zipped, bare):
        with pytest.raises(UserError, match=path.name) as caught:
            read_official_checkpoint(path)
        assert "weights_only" not in str(caught.value), "nobody is told to read it in the way that executes it"
    assert not touched.exists()
    pickle.loads(bare.read_bytes())
    assert touched.exists(), "the trap itself works"


@pytest.mark.parametrize("content", [b"", b"not a checkpoint", b"PK\x03\x04 cut short"])
def test_damaged_files_are_named(tmp_path, content):
    path = tmp_path / "broken.pth"
    path.write_bytes(content)
    with pytest.raises(UserError, match=r"broken\.pth is not a whole PyTorch checkpoint"):
        read_official_checkpoint(path)


@pytest.mark.parametrize(
    "tensor",
    [
        torch.zeros(1).expand(100_000, 100_000),
        torch.sparse_coo_tensor(torch.zeros(2, 0, dtype=torch.int64), torch.zeros(0), (100_000, 100_000)),
        torch.zeros(3, dtype=torch.complex64),
        torch.tensor([float("inf")]),
    ],
)
def test_tensors_that_are_not_in_the_file_or_not_finite_are_refused(tmp_path, tensor):
    torch.save({"stem": tensor}, tmp_path / "odd.pth")
    with pytest.raises(UserError, match="not plain tensors of finite numbers: stem"):
        read_official_checkpoint(tmp_path / "odd.pth")


def test_an_archive_that_would_fill_the_memory_is_not_unpacked(tmp_path):
    path = tmp_path / "packed.pth"
    torch.save({"stem": torch.zeros(2_000_000)}, path)
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    with pytest.raises(UserError, match="packed into far fewer"):
        read_official_checkpoint(path)


def test_a_file_without_a_state_dict_says_so(tmp_path):
    path = tmp_path / "list.pth"
    torch.save([torch.zeros(2)], path)
    with pytest.raises(UserError, match="holds no state dict"):
        read_official_checkpoint(path)
    with pytest.raises(UserError, match="There is no file"):
        read_official_checkpoint(tmp_path / "absent.pth")


def test_names_are_translated_by_one_rule_only():
    assert len(set(RULES.values())) == len(RULES) - 1, "only the old name of the offsets shares a target"
    assert name_here("head.transformer.decoder.layers.5.norms.2.bias") == "map_decoder.layers.5.norms.2.bias"
    assert name_here("head.transformer.decoder.other") is None
