"""CPU seconds of drawing demo scenes, each in a process of its own: ``python -m tests.benchmarks.scene_cost``.

``--newcomer`` compiles all loops anew, as the first scene of an installation does.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path


def prepare(scene: str, cache: Path) -> str:
    """Draw a scene into a cache folder and return a line of a table about it."""
    from predmapnet.demo_world.catalogue import ensure_scene

    ensure_scene(scene, cache)
    used = resource.getrusage(resource.RUSAGE_SELF)
    alone, megabytes = time.thread_time(), used.ru_maxrss / 1024
    # The main thread builds the world and paints the ground; then it waits for the threads that draw.
    two_cores = alone + (used.ru_utime + used.ru_stime - alone) / 2
    return f"{scene} {used.ru_utime:12.1f} {used.ru_stime:8.1f} {alone:13.1f} {two_cores:15.1f} {megabytes:8.0f}"


def main() -> None:
    """Print the table, or one line of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="*", default=["scene-0103", "scene-0104", "scene-0107"])
    parser.add_argument("--newcomer", action="store_true", help="with nothing compiled yet")
    parser.add_argument("--into", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.into:
        print(prepare(arguments.scenes[0], arguments.into), flush=True)
        return
    print("scene            user s    sys s  main thread s  2 idle cores s  peak MB", flush=True)
    for scene in arguments.scenes:
        with tempfile.TemporaryDirectory() as folder:
            compiled = {"NUMBA_CACHE_DIR": f"{folder}/compiled"} if arguments.newcomer else {}
            command = [sys.executable, "-m", "tests.benchmarks.scene_cost", "--scenes", scene, "--into", folder]
            subprocess.run(command, env=os.environ | compiled, check=True)


if __name__ == "__main__":
    main()
