"""Reads mutated files of every kind that users bring; whatever is neither a result nor an error of ours is a fault.

``python -m tests.benchmarks.fuzzed_files [READER ...] [--count 10000] [--seed 0] [--first 0]``
"""

from __future__ import annotations

import argparse
import faulthandler
import shutil
import sys
import tempfile
from pathlib import Path

from tests.fuzzing.judge import judge
from tests.fuzzing.readers import READERS

MEMORY = Path("/dev/shm")
"""Folder in which files cost little, on Linux."""


def main() -> None:
    """Print for each reader how many inputs were read and refused, and the faults with an input that shows each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("readers", nargs="*", metavar="READER", help=", ".join(READERS))
    parser.add_argument("--count", type=int, default=10_000, help="inputs of each")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="number of the first input, to see one again")
    arguments = parser.parse_args()
    faulthandler.enable()
    bad = False
    for name in arguments.readers or READERS:
        folder = Path(
            tempfile.mkdtemp(prefix=f"fuzzed-{name}-", dir=MEMORY if MEMORY.is_dir() else None)
        )  # stays where a crash ends it all
        verdict = judge(
            READERS[name], folder, range(arguments.first, arguments.first + arguments.count), arguments.seed
        )
        print(f"{name}: {verdict}", flush=True)
        for fault, numbers in sorted(verdict.faults.items(), key=lambda entry: -len(entry[1])):
            print(f"  {len(numbers)} x {fault}; for one, --first {numbers[0] if numbers else 0} --count 1", flush=True)
        bad |= bool(verdict.faults)
        shutil.rmtree(folder)
    sys.exit(bad)


if __name__ == "__main__":
    main()
