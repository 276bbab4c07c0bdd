"""Weights on disk: what is written comes back, and what does not fit is refused with a reason."""

import json
import pickle
import subprocess
import sys

import pytest
import torch
from safetensors.torch import load_file, save_file

from predmapnet.errors import UserError
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.presets import preset
from predmapnet.weights.checkpoint import load_checkpoint, save_checkpoint
from predmapnet.weights.files import weights_hash


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(3)
    return PredMapNet(preset("lite"))


@pytest.fixture
def saved(network, tmp_path):
    path = tmp_path / "net.safetensors"
    save_checkpoint(path, network, {"frames": 12})
    return path


def rewrite(path, change):
    from safetensors import safe_open

    with safe_open(path, "pt") as file:
        about = json.loads(file.metadata()["predmapnet"])
    tensors = load_file(path)
    change(tensors, about)
    save_file(tensors, path, {"predmapnet": json.dumps(about)})


def test_weights_configuration_and_facts_come_back(network, saved):
    checkpoint = load_checkpoint(saved)
    assert checkpoint.network.config == network.config and checkpoint.facts == {"frames": 12}
    assert not checkpoint.network.training and checkpoint.sha256 == weights_hash(saved)
    for name, tensor in network.state_dict().items():
        assert torch.equal(tensor, checkpoint.network.state_dict()[name]), name


def test_half_precision_is_half_the_size_and_reads_as_full(network, saved, tmp_path):
    half = tmp_path / "half.safetensors"
    save_checkpoint(half, network, half=True)
    assert half.stat().st_size < 0.55 * saved.stat().st_size
    for name, tensor in load_checkpoint(half).network.state_dict().items():
        assert tensor.dtype != torch.float16
        torch.testing.assert_close(tensor, network.state_dict()[name], atol=1e-3, rtol=1e-3)


def test_the_same_network_gives_the_same_bytes(network, saved, tmp_path):
    again = tmp_path / "again.safetensors"
    save_checkpoint(again, network, {"frames": 12})
    assert weights_hash(again) == weights_hash(saved)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda tensors, _: tensors.pop("map_decoder.input.weight"), "1 missing: map_decoder.input.weight"),
        (lambda tensors, _: tensors.update(extra=torch.zeros(1)), "1 not known: extra"),
        (lambda t, _: t.update({"query_generator.content": torch.zeros(7, 128)}), "(7, 128) instead of (40, 128)"),
        (lambda _, about: about.update(format="other"), "does not hold PredMapNet weights"),
        (lambda _, about: about.update(configuration={"wings": 2}), "wings"),
        (lambda _, about: about.pop("configuration"), "configuration"),
        (lambda _, about: about.update(facts=[]), "no object 'facts'"),
        (lambda _, about: about["configuration"]["decoder"].update(queries=60_000), "instead of (60000, 128)"),
        (lambda _, about: about["configuration"]["decoder"].update(layers=10**9), "decoder.layers"),
        (
            lambda t, _: t["query_generator.content"].fill_(float("nan")),
            "1 with NaN or infinity: query_generator.content",
        ),
        (lambda t, _: t.update({"query_generator.content": torch.zeros(40, 128).long()}), "1 of another kind"),
    ],
)
def test_what_does_not_fit_is_refused_by_name(change, words, saved):
    rewrite(saved, change)
    with pytest.raises(UserError) as caught:
        load_checkpoint(saved)
    assert words in str(caught.value) and str(saved) in str(caught.value)


def test_damaged_missing_and_pickled_files_are_refused(saved, tmp_path):
    saved.write_bytes(saved.read_bytes()[:-1000])
    with pytest.raises(UserError, match="not a whole safetensors file"):
        load_checkpoint(saved)
    with pytest.raises(UserError, match=r"no weights file .*nothing\.safetensors"):
        load_checkpoint(tmp_path / "nothing.safetensors")
    trap = tmp_path / "trap.pth"
    trap.write_bytes(pickle.dumps({"state_dict": {}}))
    with pytest.raises(UserError, match="has to be imported first"):
        load_checkpoint(trap)


def test_weights_that_fit_are_read_without_the_compiler():
    """It takes two seconds to import, and every command that maps would wait for it."""
    code = "import sys; from predmapnet.weights.checkpoint import load_checkpoint as load; load(); print(*sys.modules)"
    modules = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "torch" in modules and "torch._dynamo" not in modules


def test_a_failed_write_leaves_no_file(network, tmp_path):
    with pytest.raises(TypeError):
        save_checkpoint(tmp_path / "net.safetensors", network, {"frames": object()})
    assert list(tmp_path.iterdir()) == []
    assert json.loads(network.config.to_json())["name"] == "lite"
