"""The rooms of the house: cli may use predmapnet and mapfusion, predmapnet may use mapfusion, never the other way."""

import ast
import subprocess
import sys
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
