"""``predmapnet weights``: what it says, and what it refuses."""

import pytest
import torch
from safetensors.torch import save_file

from predmapnet.weights.files import weights_hash
from tests.predmapnet.network.maptracker_reference import FOLDER, load_reference


@pytest.mark.reference
def test_a_public_checkpoint_becomes_weights(predmapnet, tmp_path):
    if not (FOLDER / "state_dict_keys.json").is_file():
        pytest.skip(f"no reference fixtures in {FOLDER}: set PREDMAPNET_REFERENCE")
    source, out = tmp_path / "maptracker.pth", tmp_path / "weights.safetensors"
    torch.save({"meta": {"epoch": 48}, "state_dict": load_reference().official_state}, source)
    result = predmapnet("weights", "import", source, "--out", out)
    assert result.code == 0, result.err
    assert "661 entries mapped, none unexplained" in result.out
    assert "60 ignored: repetitions" in result.out
    shown = predmapnet("weights", "inspect", out)
    assert "maptracker-nuscenes" in shown.out
    assert "imported from: maptracker.pth" in shown.out
    assert "image_backbone" in shown.out
    listed = predmapnet("weights", "inspect", out, "--names")
    assert "bev_encoder.camera_code" in listed.out
    assert "6 x 256" in listed.out
    assert "modules of the paper: none" in shown.out

    result = predmapnet("weights", "import", source, "--out", out, "--preset", "paper-nuscenes")
    assert result.code == 0, result.err
    assert "tensors begin at random and have to be trained: query_generator, mask_head" in result.out
    shown = predmapnet("weights", "inspect", out)
    assert "paper-nuscenes" in shown.out and "short-term future guidance" in shown.out
    assert "untrained: query_generator, mask_head" in shown.out

    result = predmapnet("weights", "import", source, "--out", out, "--preset", "paper")
    assert (result.code, "there is no preset 'paper'" in result.err) == (2, True)


def test_mistakes_are_explained(predmapnet, tmp_path):
    absent = predmapnet("weights", "import", tmp_path / "absent.pth", "--out", tmp_path / "w.safetensors")
    assert (absent.code, "There is no file" in absent.err) == (2, True)
    wrong = predmapnet("weights", "import", tmp_path / "absent.pth", "--out", tmp_path / "w.bin")
    assert (wrong.code, "only .safetensors can be written" in wrong.err) == (2, True)
    torch.save({"state_dict": {"head.other": torch.zeros(2)}}, tmp_path / "other.pth")
    other = predmapnet("weights", "import", tmp_path / "other.pth", "--out", tmp_path / "w.safetensors")
    assert (other.code, "1 unknown: head.other" in other.err) == (2, True)
    assert not (tmp_path / "w.safetensors").exists()
    pickled = predmapnet("weights", "inspect", tmp_path / "other.pth")
    assert (pickled.code, "has to be imported first" in pickled.err) == (2, True)


def test_the_shipped_weights_are_shown_without_a_name(predmapnet):
    shown = predmapnet("weights", "inspect")
    assert shown.code == 0
    assert "lite, written by predmapnet" in shown.out
    assert "history-map guidance" in shown.out and "data: demo" in shown.out
    assert f"sha256: {weights_hash()}" in shown.out and "{" not in shown.out


def test_weights_of_other_programs_are_shown_as_such(predmapnet, tmp_path):
    save_file({"layer.weight": torch.zeros(2, 3)}, tmp_path / "foreign.safetensors")
    shown = predmapnet("weights", "inspect", tmp_path / "foreign.safetensors")
    assert shown.code == 0
    assert "not written by PredMapNet" in shown.out
    assert "1 tensor, 6 parameters" in shown.out
