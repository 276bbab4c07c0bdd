"""The rooms of the house: cli may use predmapnet and mapfusion, predmapnet may use mapfusion, never the other way."""

import ast
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.mark.parametrize(
    ("room", "forbidden"),
    [
        ("mapfusion", {"predmapnet", "cli", "torch"}),
        ("predmapnet", {"cli"}),
        ("predmapnet/datasets", {"predmapnet.demo_world"}),
        ("predmapnet/frame_files", {"predmapnet.demo_world", "predmapnet.runs"}),
    ],
)
def test_no_room_imports_from_above(room, forbidden):
    for path in sorted((ROOT / room).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
            roots = {".".join(name.split(".")[:depth]) for name in names for depth in (1, 2)}
            assert not roots & forbidden, path


def test_mapfusion_comes_without_torch():
    code = "import sys, mapfusion, mapfusion.integrate.integrator; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0


PACKAGES = ("mapfusion", "predmapnet", "cli")
FILES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported_at_once(path: Path, modules: set[str]) -> set[str]:
    """Modules of ours that a module needs before it is there itself, not in functions and not for types."""
    needed = set()
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.ImportFrom) and node.module:
            inside = {f"{node.module}.{alias.name}" for alias in node.names} & modules
            needed |= inside or {node.module} & modules
        elif isinstance(node, ast.Import):
            needed |= {alias.name for alias in node.names} & modules
    return needed - {module_name(path)}


def test_no_modules_import_each_other_in_a_circle():
    modules = {module_name(path) for path in FILES}
    graph = {module_name(path): imported_at_once(path, modules) for path in FILES}
    list(TopologicalSorter(graph).static_order())  # raises CycleError


def test_files_have_one_subject_and_public_names_one_meaning():
    """Commands of the command line are called like what they do, so ``cli`` does not count."""
    owners: dict[str, set[str]] = {}
    for path in FILES:
        source = path.read_text()
        assert source.count("\n") <= 400, path
        if not path.is_relative_to(ROOT / "cli"):
            for node in ast.parse(source).body:
                if isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_"):
                    owners.setdefault(node.name, set()).add(module_name(path))
    assert {name: found for name, found in owners.items() if len(found) > 1} == {}


def texts(source: str) -> list[str]:
    """Docstrings of a file, and the texts below its constants and attributes."""
    owners = (ast.Module, ast.ClassDef, ast.FunctionDef)
    nodes = [node for owner in ast.walk(ast.parse(source)) if isinstance(owner, owners) for node in owner.body]
    statements = [node for node in nodes if isinstance(node, ast.Expr)]
    constants = [node.value.value for node in statements if isinstance(node.value, ast.Constant)]
    return [text.strip() for text in constants if isinstance(text, str)]


def test_docstrings_begin_with_their_subject():
    questions = ("What", "Which", "How", "Where", "Who", "Why", "When")
    found = [(path.name, text) for path in FILES for text in texts(path.read_text()) if text.split()[0] in questions]
    assert found == []
