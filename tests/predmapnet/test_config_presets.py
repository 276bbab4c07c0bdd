"""The configuration: presets, files, and what is refused."""

import json

import pytest
from pydantic import ValidationError

from predmapnet.config import PredMapNetConfig
from predmapnet.errors import UserError
from predmapnet.presets import load_config, parse_config, preset


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


def test_files_without_kinds_are_those_of_lite():
    old = '{"backbone": {"channels": 24}, "bev": {"rows": 40}, "decoder": {"queries": 30}, "temporal_bev": {}}'
    config = parse_config(old, "here")
    kinds = [config.image.kind, config.backbone.kind, config.bev.kind, config.temporal_bev.kind, config.decoder.kind]
    assert kinds == ["window", "small", "lookup", "residual", "points"]
    assert (config.backbone.channels, config.bev.rows, config.decoder.queries) == (24, 40, 30)


@pytest.mark.parametrize(
    ("sections", "words"),
    [
        ({"backbone": {"kind": "small"}}, "'bevformer' reads the three levels"),
        ({"temporal_bev": {"kind": "residual"}}, "needs temporal_bev 'encoder'"),
        ({"backbone": {"kind": "resnet50", "channels": 128}}, "backbone.channels"),
        ({"masks": {"stride": 2}}, "masks.stride"),
        ({"tracking": {"query_assignment": "one_way"}}, "'maptracker' lets detections see tracks"),
        ({"decoder": {"kind": "points"}}, "decoder 'maptracker': norm_before_cross_attention"),
    ],
)
def test_parts_that_do_not_fit_together_are_refused(sections, words):
    values = preset("maptracker-nuscenes").model_dump()
    with pytest.raises(ValidationError, match=words):
        PredMapNetConfig.model_validate({**values, **sections})


@pytest.mark.parametrize(
    ("section", "values", "words"),
    [
        ("decoder", {"heads": 5}, "decoder.width has to be a multiple of decoder.heads"),
        ("decoder", {"width": 30, "heads": 3}, "decoder.width has to be a multiple of 4"),
        ("decoder", {"classes": 4}, "Input should be 3"),
        ("decoder", {"memory_distances": [5.0, 1.0]}, "memory_distances: should increase"),
        ("bev", {"heads": 5}, "bev.width has to be even and a multiple of bev.heads"),
        ("bev", {"pillar_points": 3}, "bev.pillar_points has to divide 8"),
        ("bev", {"pillar_low": 5.0}, "bev.pillar_low has to be below bev.pillar_high"),
        ("temporal_bev", {"distances": []}, "temporal_bev.distances: Tuple should have at least 1"),
        ("depth", {"near": 40.0}, "depth.near has to be less than depth.far"),
    ],
)
def test_sizes_that_no_network_can_have_are_refused_before_it_is_built(section, values, words):
    config = json.loads(preset("paper-nuscenes").to_json())
    config[section] |= values
    with pytest.raises(UserError, match=words):
        parse_config(json.dumps(config), "here")


def test_quirks_of_other_parts_are_refused():
    with pytest.raises(ValidationError, match="quirks without what they are quirks of, bev 'bevformer'"):
        PredMapNetConfig.model_validate({"quirks": {"mirrored_self_attention": True}})


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"decoder": {"kind": "best"}}', "decoder: Input tag 'best'"),
        ('{"decoder": {"kind": "maptracker", "point_width": 3}}', "decoder.point_width"),
        ('{"wings": 2}', "wings"),
        ('{"tracking": {"tau_d": 1.5}}', "tracking.tau_d"),
        ('{"decoder": {"queries": "many"}}', "decoder.queries"),
        ('{"history_map": {"memory": false}}', "guidance reads the memory"),
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
