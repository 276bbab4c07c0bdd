"""Makes the pictures of the README: ``python -m tests.benchmarks.pictures``; minutes without a GPU.

Needs Rerun's viewer, and where there is no display Xvfb and a software Vulkan driver (on Debian: ``apt-get install xvfb
mesa-vulkan-drivers libxkbcommon-x11-0``). The scene is mapped with the shipped weights in the demo world.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2

EXAMPLES = Path(__file__).parents[2] / "examples"
SCENE = "scene-0103"
SIZE = (1400, 900)


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--recording", type=Path, help="of the scene; it is made if none is named")
    named = arguments.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        recording = named.recording or Path(folder) / f"{SCENE}.rrd"
        if named.recording is None:
            run("cli.main", "infer", SCENE, "--out", f"{folder}/map.geojson", "--recording", str(recording))
        picture_of(recording, EXAMPLES / f"{SCENE}.png")


def run(module: str, *arguments: str) -> None:
    subprocess.run([sys.executable, "-m", module, *arguments], check=True)


def picture_of(recording: Path, picture: Path) -> None:
    """Write a picture of a recording as it opens."""
    viewer = [sys.executable, "-m", "rerun_cli"]
    if not os.environ.get("DISPLAY"):
        if shutil.which("xvfb-run") is None:
            sys.exit("There is no display here, and no xvfb-run: see python -m tests.benchmarks.pictures --help")
        viewer = ["xvfb-run", "-a", *viewer, "--renderer", "vulkan"]
    with tempfile.TemporaryDirectory() as folder:
        shot = Path(folder) / "shot.png"
        options = ["--screenshot-to", str(shot), "--window-size", "{}x{}".format(*SIZE), "--port", "auto"]
        subprocess.run([*viewer, str(recording), *options], check=True, stderr=subprocess.DEVNULL)
        write_small(shot, picture)
    print(f"written: {picture} ({picture.stat().st_size / 1000:.0f} kB)")


def write_small(shot: Path, picture: Path) -> None:
    """Write a screenshot at its size on the screen, with 256 colours: a quarter of the bytes."""
    from PIL import Image

    large = cv2.imread(str(shot))
    assert large is not None, f"{shot} is no picture"
    small = cv2.resize(large, SIZE, interpolation=cv2.INTER_AREA)
    image = Image.fromarray(cv2.cvtColor(small, cv2.COLOR_BGR2RGB))
    image.quantize(256, dither=Image.Dither.NONE).save(picture, optimize=True)


if __name__ == "__main__":
    main()
