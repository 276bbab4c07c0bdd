"""A batch on a Ray cluster of two nodes through everything that can be killed, beside an undisturbed ``infer``.

    python -m tests.benchmarks.fleet_kills [--scenes 24]

It takes Linux and root. A worker, a node and the driver are killed on the way; two scenes have a damaged image, one
never ends. In the end every other map must equal that of ``infer`` byte for byte but for its time stamp, the failure
table must hold exactly those three, and no scene may have been mapped again after it was done.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from tests.cli.random_weights import write_random_weights
from tests.cli.tiny_nuscenes import image_path, write_tiny_nuscenes

T = TypeVar("T")
BROKEN = ("scene-0003", "scene-0011")
HANGING = "scene-9999"
ENDLESS = Path("/proc/kmsg")
"""A regular file that root may read, and whose reader waits for what the kernel will say next."""


def without_time(path: Path) -> bytes:
    """Return a map without the time stamp."""
    return re.sub(rb'"created":"[^"]*"', b"", path.read_bytes())


def write_data(root: Path, count: int) -> Path:
    """Write the scenes and their manifest; an image of the hanging one has no end."""
    names = tuple(f"scene-{number:04d}" for number in range(count - 1))
    data = write_tiny_nuscenes(root / "data", names, frames=3)
    for name in BROKEN:
        path = image_path(data, name, 1, "CAM_FRONT")
        path.write_bytes(path.read_bytes()[:900])
    hanging = write_tiny_nuscenes(root / "hanging", (HANGING,), frames=1)
    image_path(hanging, HANGING, 0, "CAM_FRONT").unlink()
    image_path(hanging, HANGING, 0, "CAM_FRONT").symlink_to(ENDLESS)
    lines = [*(f"{name},data" for name in names), f"{HANGING},hanging"]
    (root / "list.csv").write_text("\n".join(["scene,folder", lines[-1], *lines[:-1]]) + "\n")
    return root / "list.csv"


def infer_all(root: Path, names: list[str], weights: Path, out: Path) -> None:
    """Map the whole scenes one after the other, as ``infer`` does."""
    from predmapnet.machine import THREADS_PER_SCENE, NetworkOptions, use_threads

    use_threads(THREADS_PER_SCENE)
    from predmapnet.runs.infer import MappingPipeline
    from predmapnet.runs.outputs import Outputs

    out.mkdir()
    pipeline = MappingPipeline.open(None, root / "data", NetworkOptions(weights))
    for name in names:
        pipeline.run(name, Outputs(map=out / f"{name}.geojson"))


def wait_for(what: Callable[[], bool], driver: subprocess.Popen[bytes], seconds: float = 1200) -> None:
    """Wait until something holds; the driver must be alive until then."""
    deadline = time.monotonic() + seconds
    while not what():
        if driver.poll() is not None or time.monotonic() > deadline:
            raise RuntimeError(f"the driver ended too early: {driver.poll()}")
        time.sleep(0.1)


def tried(make: Callable[[], T]) -> T:
    """Try again what a busy machine does not start within Ray's time."""
    for _ in range(9):
        try:
            return make()
        except Exception as error:
            print(f"trying again: {error}", flush=True)
    return make()


def mapping_processes() -> list[int]:
    """Return the processes of Ray's actors on this machine."""
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                title = (folder / "cmdline").read_bytes()
            except OSError:
                continue
            if title.startswith(b"ray::_RayWorker"):
                found.append(int(folder.name))
    return found


def main() -> None:
    """Run it and print what was found; exits with 1 if anything is not as it must be."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--scenes", type=int, default=24)
    count = parser.parse_args().scenes
    from ray.cluster_utils import Cluster

    with tempfile.TemporaryDirectory(prefix="fleet-") as temporary:
        root = Path(temporary)
        manifest, weights = write_data(root, count), write_random_weights(root / "weights.safetensors")
        whole = [f"scene-{number:04d}" for number in range(count - 1) if f"scene-{number:04d}" not in BROKEN]
        infer_all(root, whole, weights, root / "infer")
        cluster = tried(lambda: Cluster(initialize_head=True, head_node_args={"num_cpus": 0}))
        nodes = [tried(lambda: cluster.add_node(num_cpus=2)) for _ in range(2)]
        out = root / "maps"
        arguments = ["batch", str(manifest), "--out", str(out), "--weights", str(weights), "--engine", "ray"]
        arguments += ["--address", cluster.address, "--jobs", "2", "--scene-timeout", "30"]
        command = [sys.executable, "-m", "cli.main", *arguments]

        def done() -> dict[str, int]:
            return {path.name.split(".")[0]: path.stat().st_mtime_ns for path in out.glob("*.summary.json")}

        with subprocess.Popen(command) as driver:
            wait_for(lambda: len(done()) >= 2, driver)
            victim = mapping_processes()[0]
            os.kill(victim, signal.SIGKILL)
            print(f"killed a worker (process {victim}) after {len(done())} scenes", flush=True)
            wait_for(lambda: len(done()) >= count // 4, driver)
            cluster.remove_node(nodes[0], allow_graceful=False)
            print(f"killed a node after {len(done())} scenes", flush=True)
            wait_for(lambda: len(done()) >= count // 2, driver)
            driver.send_signal(signal.SIGKILL)
        before = done()
        print(f"killed the driver after {len(before)} scenes", flush=True)
        tried(lambda: cluster.add_node(num_cpus=2))
        code = subprocess.run(command, check=False).returncode
        cluster.shutdown()
        again = [name for name, when in before.items() if done().get(name) != when]
        differing = [
            name
            for name in whole
            if not (out / f"{name}.geojson").is_file()
            or without_time(out / f"{name}.geojson") != without_time(root / "infer" / f"{name}.geojson")
        ]
        summary = json.loads((out / "summary.json").read_text())
        failed = {scene["scene"]: scene["error"] for scene in summary["scenes"] if scene["status"] == "failed"}
        leftovers = [path.name for path in out.iterdir() if ".part" in path.name]
        print(f"{len(whole) - len(differing)} of {len(whole)} maps equal those of infer; differing: {differing}")
        print(f"failed: {failed}; mapped again after they were done: {again}; left behind: {leftovers}")
        expected = dict.fromkeys(BROKEN, "UserError") | {HANGING: "TimeLimitError"}
        if differing or again or leftovers or failed != expected or code != 1 or not (out / "report.html").is_file():
            sys.exit(1)


if __name__ == "__main__":
    main()
