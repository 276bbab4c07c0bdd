"""The configuration: presets, files, and what is refused."""

import json

import pytest
from pydantic import ValidationError

from predmapnet.config import PredMapNetConfig
from predmapnet.errors import UserError
from predmapnet.network.predmapnet import PredMapNet
from predmapnet.presets import load_config, parse_config, preset
from tests.predmapnet.small_networks import small_config


def test_json_brings_a_configuration_back():
    config = PredMapNetConfig.model_validate({"tracking": {"tau_d": 0.41}, "future": {"enabled": False}})
    assert parse_config(config.to_json(), "here") == config != preset("lite")


def test_the_hyperparameters_of_section_4_1_that_lite_shares():
    config = preset("lite")
    assert config.decoder.points == 20 and config.semantic_queries.mask_threshold == 0.5
    assert config.history_map.beta == 0.9 and config.history_map.threshold == 0.5 and config.future.histories == 4


@pytest.mark.parametrize(("name", "cameras", "height", "width"), [("nuscenes", 6, 480, 800), ("av2", 7, 608, 608)])
def test_the_paper_s_network_and_its_baseline(name, cameras, height, width):
    """Sec. 4.1; with the paper's sections put back, it is the baseline."""
    paper, baseline = preset(f"paper-{name}"), preset(f"maptracker-{name}")
    assert (paper.decoder.queries, paper.decoder.points, paper.decoder.width) == (100, 20, 512)
    assert (paper.tracking.tau_d, paper.tracking.first_tau_d, paper.tracking.tau_t) == (0.4, None, 0.5)
    assert (paper.history_map.beta, paper.history_map.threshold, paper.future.histories) == (0.9, 0.5, 4)
    assert paper.semantic_queries.enabled and paper.history_map.guidance and paper.future.enabled
    assert paper.depth.enabled and not paper.future.steady_motion and not paper.revival.enabled
    assert (paper.image.height, paper.image.width, len(paper.bev.cameras)) == (height, width, cameras)
    assert (paper.bev.rows, paper.bev.columns, paper.mask_size) == (50, 100, (50, 100))
    own = ("name", "semantic_queries", "history_map", "future", "tracking", "depth")
    assert paper.model_copy(update={section: getattr(baseline, section) for section in own}) == baseline
    assert parse_config(paper.to_json(), "here") == paper


def test_weights_of_the_former_layout_are_read():
    """Parts stood beside what they belong to, and sections without a kind are those of lite."""
    old = {
        "backbone": {"kind": "small", "channels": 24},
        "bev": {"rows": 40},
        "temporal_bev": {"capacity": 3},
        "masks": {"stride": 1, "channels": 16},
        "tracking": {"query_assignment": "suppress", "tau_d": 0.4},
        "quirks": {"mirrored_self_attention": False, "norm_before_cross_attention": False},
    }
    config = parse_config(json.dumps(old), "here")
    assert [config.image.kind, config.bev.kind, config.decoder.kind] == ["window", "lookup", "points"]
    assert (config.bev.backbone.channels, config.bev.rows, config.bev.memory.capacity) == (24, 40, 3)
    assert (config.bev.mask_stride, config.masks.channels) == (1, 16)
    assert (config.decoder.query_assignment, config.tracking.tau_d) == ("suppress", 0.4)
    assert parse_config(config.to_json(), "here") == config


def test_weights_of_maptracker_in_the_former_layout_are_read():
    present = json.loads(preset("maptracker-nuscenes").to_json())
    old = present | {
        "backbone": {"kind": "resnet50", "channels": 256},
        "temporal_bev": {"kind": "encoder", **present["bev"].pop("memory")},
        "quirks": present["bev"].pop("quirks") | present["decoder"].pop("quirks"),
    }
    old["masks"]["stride"] = present["bev"].pop("mask_stride")
    old["tracking"]["query_assignment"] = present["decoder"].pop("query_assignment")
    assert parse_config(json.dumps(old), "here") == preset("maptracker-nuscenes")


def test_without_the_history_maps_nothing_is_guided_by_them():
    network = PredMapNet(small_config("lite", history_map={"memory": False}))
    assert network.history_guidance is None


@pytest.mark.parametrize(
    ("section", "values", "words"),
    [
        ("decoder", {"heads": 5}, "decoder: width 512 has to be a multiple of heads"),
        ("decoder", {"width": 30, "heads": 3}, "decoder.width: Input should be a multiple of 4"),
        ("decoder", {"classes": 4}, "Input should be 3"),
        ("decoder", {"query_assignment": "one_way"}, "decoder.query_assignment: Input should be 'suppress'"),
        ("bev", {"mask_stride": 2}, "bev.mask_stride: Input should be 1"),
        ("bev", {"width": 33, "heads": 3}, "bev.width: Input should be a multiple of 2"),
        ("bev", {"backbone": {}}, "bev.backbone: Extra inputs are not permitted"),
        ("decoder", {"memory_distances": [5.0, 1.0]}, "memory_distances: should increase"),
        ("bev", {"heads": 5}, "bev: width 256 has to be a multiple of heads"),
        ("bev", {"pillar_points": 3}, "bev.pillar_points: Input should be 1, 2, 4 or 8"),
        ("bev", {"pillar_low": 5.0}, "bev: pillar_low has to be below pillar_high"),
        ("bev", {"memory": {"distances": []}}, "bev.memory.distances: Tuple should have at least 1"),
        ("depth", {"near": 40.0}, "depth: near has to be less than far"),
    ],
)
def test_sizes_that_no_network_can_have_are_refused_before_it_is_built(section, values, words):
    config = json.loads(preset("paper-nuscenes").to_json())
    config[section] |= values
    with pytest.raises(UserError, match=words):
        parse_config(json.dumps(config), "here")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"decoder": {"kind": "best"}}', "decoder: Input tag 'best'"),
        ('{"decoder": {"kind": "maptracker", "point_width": 3}}', "decoder.point_width"),
        ('{"wings": 2}', "wings"),
        ('{"tracking": {"tau_d": 1.5}}', "tracking.tau_d"),
        ('{"decoder": {"queries": "many"}}', "decoder.queries"),
        ('{"bev": {"quirks": {"endpoint_warp_grid": true}}}', "bev.quirks"),
        ("{", "JSON"),
    ],
)
def test_what_does_not_fit_is_named(text, words, tmp_path):
    path = tmp_path / "net.json"
    path.write_text(text)
    with pytest.raises(UserError) as caught:
        load_config(path)
    assert words in str(caught.value) and str(path) in str(caught.value)


def test_unknown_presets_and_files():
    with pytest.raises(UserError, match="no preset 'light'; choose one of: lite"):
        load_config("light")
    with pytest.raises(UserError, match="no configuration file"):
        load_config("nothing.json")


def test_a_configuration_cannot_be_changed():
    with pytest.raises(ValidationError):
        preset("lite").decoder.queries = 50
