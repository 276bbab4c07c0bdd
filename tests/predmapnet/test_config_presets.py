"""The configuration: presets, files, and what is refused."""

import pytest
from pydantic import ValidationError

from predmapnet.config import PredMapNetConfig, load_config, parse_config, preset
from predmapnet.errors import UserError


def test_json_brings_a_configuration_back():
    config = PredMapNetConfig.model_validate({"tracking": {"tau_d": 0.41}, "future": {"enabled": False}})
    assert parse_config(config.to_json(), "here") == config != preset("lite")


def test_the_hyperparameters_of_section_4_1_that_lite_shares():
    config = preset("lite")
    assert config.decoder.points == 20 and config.semantic_queries.mask_threshold == 0.5
    assert config.history_map.beta == 0.9 and config.history_map.threshold == 0.5 and config.future.histories == 4


@pytest.mark.parametrize(
    ("text", "words"),
    [
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
