"""The modules of mapfusion import each other in one direction, and its front door offers what it says."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import mapfusion

ROOT = Path(mapfusion.__file__).parent


def imported_modules(path: Path) -> set[str]:
    nodes = ast.walk(ast.parse(path.read_text()))
    names = {node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)}
    return {name for name in names if name.startswith("mapfusion.")}


def test_no_modules_import_each_other_in_a_circle():
    modules = {
        ".".join(path.relative_to(ROOT.parent).with_suffix("").parts).removesuffix(".__init__"): imported_modules(path)
        for path in ROOT.rglob("*.py")
    }
    assert len(modules) > 20
    list(TopologicalSorter(modules).static_order())  # raises CycleError


def test_every_public_name_is_there_and_documented():
    for name in mapfusion.__all__:
        assert getattr(mapfusion, name).__doc__, name
