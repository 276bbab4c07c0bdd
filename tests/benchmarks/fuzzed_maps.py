"""Reads mutated map files of every format and counts what happens; anything but a map or a ValueError ends it.

``python -m tests.benchmarks.fuzzed_maps [--inputs 10000] [--seed 0]``
"""

from __future__ import annotations

import argparse
import random
import re
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np

from mapfusion import ElementKind, GlobalMap, MapElement
from mapfusion.formats.by_suffix import SUFFIXES, read_map, read_maps, write_map
from mapfusion.formats.local_plane import LocalPlane

VALUES = ["", "x", "-1", "0", "1e308", "nan", "inf", "[]", "{}", "null", "true", "9" * 25, "solid", "divider", "<a>"]
TOKEN = re.compile(rb'"[^"]*"|-?\d+(?:\.\d+)?(?:e-?\d+)?|null|true')
SLOWEST = 10.0
"""Seconds that one file may take."""


def example() -> GlobalMap:
    """Return a map with all that an element may have."""
    elements = []
    for kind, points in (
        (ElementKind.DIVIDER, [[0, 0], [30, 0.5], [60, 0]]),
        (ElementKind.BOUNDARY, [[0, 20], [30, 20], [60, 20]]),
        (ElementKind.PED_CROSSING, [[20, 2], [24, 2], [24, 12], [20, 12], [20, 2]]),
    ):
        line = np.array(points, dtype=np.float64)
        sources, size = (("drive",), ((3,),)), len(line)
        elements.append(
            MapElement(kind, line, 0.97, 9, 5_000, 6_000, (3,), np.full(size, 0.1), *sources, np.full(size, 99.5))
        )
    observed = LocalPlane(8.4, 49.0).to_wgs84(np.array([[-90.0, -90], [90, -90], [90, 90], [-90, -90]])).tolist()
    return GlobalMap(tuple(elements), {"scene": "scene-0103", "observed": [observed]})


def mutated(content: bytes, generator: random.Random) -> bytes:
    """Return content with values exchanged or bytes changed, doubled or cut off."""
    for _ in range(generator.choice([1, 1, 2, 5])):
        tokens = list(TOKEN.finditer(content)) if generator.random() < 0.6 else []
        at = generator.randrange(max(len(content), 1))
        if tokens:
            token, value = generator.choice(tokens), generator.choice(VALUES).encode()
            quoted = b'"%b"' % value if token[0].startswith(b'"') else value
            content = content[: token.start()] + quoted + content[token.end() :]
        elif generator.random() < 0.5:
            content = content[:at] + bytes([generator.randrange(256)]) + content[at + generator.choice([0, 1, 40]) :]
        else:
            content = content[:at] + (
                content[at // 2 : at // 2 + 50] + content[at:] if generator.random() < 0.8 else b""
            )
    return content


def main() -> None:
    """Print for each format how many inputs were read and how many refused."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    for suffix in SUFFIXES:
        generator = random.Random(f"{suffix}{arguments.seed}")
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"map{suffix}"
            write_map(example(), path, LocalPlane(8.4, 49.0))
            content, seen, slowest = path.read_bytes(), {"read": 0, "refused": 0}, 0.0
            for _ in range(arguments.inputs):
                path.write_bytes(mutated(content, generator))
                begun = time.perf_counter()
                try:
                    read_maps([path])
                    read_map(path)
                    seen["read"] += 1
                except (ValueError, OSError):
                    seen["refused"] += 1
                slowest = max(slowest, time.perf_counter() - begun)
                assert slowest < SLOWEST, f"{suffix}: {slowest:.0f} s for one file"
            left = sorted(found.name for found in Path(folder).iterdir() if found != path)
            assert set(left) <= {"map_projector_info.yaml"}, left
        print(f"{suffix}: {seen['read']} read, {seen['refused']} refused, {slowest:.2f} s at most", flush=True)


if __name__ == "__main__":
    main()
