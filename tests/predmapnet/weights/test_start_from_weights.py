"""Training may begin with the weights of a network that has fewer modules."""

from pathlib import Path

import pytest
import torch

from predmapnet.errors import UserError
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.weights.fit import start_from
from predmapnet.weights.inspection import parts_of
from tests.predmapnet.small_networks import small_config

PLAIN = {
    "semantic_queries": {"enabled": False},
    "history_map": {"memory": False, "guidance": False},
    "future": {"enabled": False},
}


def make(sections: dict[str, dict[str, object]], seed: int) -> PredMapNet:
    torch.manual_seed(seed)
    return PredMapNet(small_config("lite", **sections))


def test_what_the_weights_have_is_taken_and_the_modules_keep_their_random_beginning():
    plain, whole, untouched = make(PLAIN, 0), make({}, 1), make({}, 1)
    fresh = start_from(whole, plain.state_dict(), Path("plain.safetensors"))
    assert set(parts_of(fresh)) == {"query_generator", "mask_head", "history_guidance", "future_guidance"}
    for name, tensor in whole.state_dict().items():
        expected = untouched if name in fresh else plain
        assert torch.equal(tensor, expected.state_dict()[name])
    assert start_from(make({}, 2), whole.state_dict(), Path("whole.safetensors")) == []


def test_weights_of_another_network_are_refused_and_named():
    whole = make({}, 0)
    with pytest.raises(UserError, match=r"fewer\.safetensors do not fit.*\(\d+ tensors: .*Choose the --preset"):
        start_from(make(PLAIN, 0), whole.state_dict(), Path("fewer.safetensors"))
    wider = make({"decoder": {"queries": 9}}, 0)
    with pytest.raises(UserError, match=r"query_generator\.content \(9, 32\) instead of \(8, 32\)"):
        start_from(whole, wider.state_dict(), Path("wider.safetensors"))


def test_the_network_of_the_paper_begins_with_maptrackers_weights():
    torch.manual_seed(0)
    maptracker, paper = PredMapNet(small_config("maptracker-nuscenes")), PredMapNet(small_config("paper-nuscenes"))
    fresh = start_from(paper, maptracker.state_dict(), Path("maptracker.safetensors"))
    assert set(paper.state_dict()) - set(fresh) == set(maptracker.state_dict())
    assert not [name for name in fresh if name.startswith(("image_backbone", "bev_encoder", "map_decoder"))]
