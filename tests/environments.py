"""Environments of their own for packages that cannot share ours; kept in PREDMAPNET_ENVIRONMENTS if that is set."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

PY123D = (
    "--no-deps py123d==0.7.0",
    "numpy pandas scipy pyarrow shapely networkx msgpack trimesh pyproj requests pillow opencv-python-headless rtree "
    "typing_extensions pyyaml ray psutil laspy lazrs cachetools pyquaternion mapbox-earcut omegaconf hydra-core "
    "DracoPy tqdm",
)
"""Packages for :func:`python_with` of py123d, without its viewer and notebooks."""


def python_with(name: str, folder: Path, *packages: str) -> Path:
    """Return the Python of an environment with packages, made below ``folder`` unless it is kept."""
    home = Path(os.environ.get("PREDMAPNET_ENVIRONMENTS", folder)) / name
    python, done = home / "bin" / "python", home / "packages.txt"
    if not done.is_file() or done.read_text() != "\n".join(packages):
        subprocess.run([sys.executable, "-m", "venv", "--clear", home], check=True)
        for package in packages:  # "--no-deps NAME" leaves out what a package drags in
            subprocess.run([python, "-m", "pip", "install", "--quiet", *package.split()], check=True)
        done.write_text("\n".join(packages))
    return python


def printed_json(python: Path, script: Path, *arguments: object) -> Any:
    """Return what a script prints as JSON when it runs in that environment."""
    run = subprocess.run(
        [python, script, *map(str, arguments)],
        capture_output=True,
        text=True,
        env={**os.environ, "MPLBACKEND": "agg", "PYTHONPATH": ""},
        check=False,
    )
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout.splitlines()[-1])
