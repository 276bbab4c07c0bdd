"""``import predmapnet as pmn`` offers what scripts need, and is quick."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import predmapnet as pmn

ROOT = Path(__file__).parents[2]


def test_importing_the_package_loads_no_torch():
    code = "import sys, predmapnet; dir(predmapnet); predmapnet.NetworkOptions(); sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0


def test_every_name_that_is_promised_is_there():
    assert pmn.Mapper.__module__ == "predmapnet.mapper"
    for name in pmn.__all__:
        assert getattr(pmn, name) is not None
    assert set(pmn.__all__) <= set(dir(pmn))
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = pmn.nothing


def test_no_module_hides_a_name_that_is_promised():
    modules = {path.stem for path in (ROOT / "predmapnet").iterdir()}
    assert not modules & set(pmn.__all__)


def test_type_checkers_see_the_same_names_as_scripts():
    tree = ast.parse((ROOT / "predmapnet" / "__init__.py").read_text())
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    shown = {(line.module, alias.name) for line in block.body for alias in line.names}
    assert shown == {(module, name) for module, names in pmn._MODULES.items() for name in names}
    assert {name for _, name in shown} == set(pmn.__all__)
