"""Training may begin with the weights of a network that has fewer modules."""

from pathlib import Path

import pytest
import torch

from predmapnet.config import PredMapNetConfig
from predmapnet.errors import UserError
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.weights.fit import start_from
from predmapnet.weights.inspection import parts_of
from tests.predmapnet.network.small_baseline import small_config

SMALL = {
    "image": {"width": 64, "height": 24},
    "backbone": {"stem": (8, 8), "widths": (8, 8, 16), "blocks": (1, 1, 1), "channels": 8},
    "bev": {"rows": 26, "columns": 52, "widths": (16, 24, 32)},
    "decoder": {"queries": 8, "points": 6, "width": 32, "heads": 4, "layers": 2, "point_width": 16},
    "future": {"hidden": 32},
}
PLAIN = SMALL | {
    "semantic_queries": {"enabled": False},
    "history_map": {"memory": False, "guidance": False},
    "future": {"hidden": 32, "enabled": False},
}


def make(sections: dict[str, object], seed: int) -> PredMapNet:
    torch.manual_seed(seed)
    return PredMapNet(PredMapNetConfig.model_validate(sections))


def test_what_the_weights_have_is_taken_and_the_modules_keep_their_random_beginning():
    plain, whole, untouched = make(PLAIN, 0), make(SMALL, 1), make(SMALL, 1)
    fresh = start_from(whole, plain.state_dict(), Path("plain.safetensors"))
    assert set(parts_of(fresh)) == {"query_generator", "mask_head", "history_guidance", "future_guidance"}
    for name, tensor in whole.state_dict().items():
        expected = untouched if name in fresh else plain
        assert torch.equal(tensor, expected.state_dict()[name])
    assert start_from(make(SMALL, 2), whole.state_dict(), Path("whole.safetensors")) == []


def test_weights_of_another_network_are_refused_and_named():
    whole = make(SMALL, 0)
    with pytest.raises(UserError, match=r"fewer\.safetensors do not fit.*\(\d+ tensors: .*Choose the --preset"):
        start_from(make(PLAIN, 0), whole.state_dict(), Path("fewer.safetensors"))
    wider = make(SMALL | {"decoder": {**SMALL["decoder"], "queries": 9}}, 0)
    with pytest.raises(UserError, match=r"query_generator\.content \(9, 32\) instead of \(8, 32\)"):
        start_from(whole, wider.state_dict(), Path("wider.safetensors"))


def test_the_network_of_the_paper_begins_with_maptrackers_weights():
    torch.manual_seed(0)
    maptracker, paper = PredMapNet(small_config("maptracker-nuscenes")), PredMapNet(small_config("paper-nuscenes"))
    fresh = start_from(paper, maptracker.state_dict(), Path("maptracker.safetensors"))
    assert set(paper.state_dict()) - set(fresh) == set(maptracker.state_dict())
    assert not [name for name in fresh if name.startswith(("image_backbone", "bev_encoder", "map_decoder"))]
