"""Help of every command: whole at 80 columns, ``-h``, completion, ``python -m predmapnet``, and exit codes."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import typer

import predmapnet as package
from cli.main import app

ROOT = Path(package.__file__).parents[1]
PAGES = [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")]
ENVIRONMENT = {**os.environ, "COLUMNS": "80"}


def every_command() -> dict[tuple[str, ...], object]:
    found = {}
    for name, command in typer.main.get_command(app).commands.items():
        inner = getattr(command, "commands", None)
        found.update({(name, key): one for key, one in inner.items()} if inner else {(name,): command})
    return found


@pytest.mark.parametrize("words", every_command(), ids=" ".join)
def test_the_help_of_a_command_is_whole_at_80_columns(predmapnet, monkeypatch, words):
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("TERMINAL_WIDTH", "80")
    result = predmapnet(*words, "-h")
    assert result.code == 0
    assert max(map(len, result.out.splitlines())) <= 80
    assert "…" not in result.out
    assert "<bool>" not in result.out
    assert "{" not in result.out
    for parameter in every_command()[words].params:
        for option in (*parameter.opts, *parameter.secondary_opts):
            if option.startswith("-"):
                assert option in result.out


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_documented_options_exist(page):
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    for words, found in every_command().items():
        known = {option for parameter in found.params for option in (*parameter.opts, *parameter.secondary_opts)}
        for line in re.findall(rf"predmapnet {' '.join(words)}\b([^\n`#]*)", text):
            assert set(re.findall(r"--[a-z][a-z-]*", line)) <= known | {"--help"}, (words, line)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_documented_benchmarks_and_their_options_exist(page):
    for module, line in re.findall(r"python -m (tests(?:\.\w+)+)([^\n`|]*)", page.read_text(encoding="utf-8")):
        code = ROOT.joinpath(*module.split(".")).with_suffix(".py").read_text(encoding="utf-8")
        for option in re.findall(r"--[a-z][a-z-]*", line):
            assert f'"{option}"' in code, (module, option)


def test_every_command_speaks_json():
    assert [
        words for words, found in every_command().items() if "--json" not in str([p.opts for p in found.params])
    ] == []


def test_the_first_help_tells_the_exit_codes_and_installs_completion(predmapnet, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    said = predmapnet("--help").out
    codes = dict(re.findall(r"^ +(\d+) +(.+)$", said, re.MULTILINE))
    assert set(codes) == {"0", "1", "2", "3", "130"}
    assert "diff --exit-code" in codes["1"]
    assert "--install-completion" in said


@pytest.mark.parametrize("words", [(), ("log",), ("weights",)])
def test_what_a_command_does_is_said_in_whole_sentences(predmapnet, monkeypatch, words):
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("TERMINAL_WIDTH", "80")
    said = predmapnet(*words, "-h").out.partition("Commands:")[2]
    assert said.count(".\n") >= 2
    assert "..." not in said


def test_words_are_completed():
    asked = {"_PREDMAPNET_COMPLETE": "complete_bash", "COMP_WORDS": "predmapnet inf", "COMP_CWORD": "1"}
    command = [sys.executable, "-m", "predmapnet"]
    done = subprocess.run(command, env=ENVIRONMENT | asked, capture_output=True, text=True, timeout=300)
    assert done.stdout.split() == ["infer"], done.stderr


def test_the_package_runs_as_the_command():
    command = [sys.executable, "-m", "predmapnet", "--version"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.stdout == f"predmapnet {package.__version__}\n", done.stderr


def test_a_device_that_does_not_exist_is_one_short_message(predmapnet, tiny_root):
    result = predmapnet("infer", "scene-0001", "-o", "m.geojson", "--data-root", tiny_root, "--device", "gpu")
    assert result.code == 2
    assert result.err.strip().splitlines()[-1] == "Error: There is no device 'gpu'. Choose auto, cpu, cuda or mps."
