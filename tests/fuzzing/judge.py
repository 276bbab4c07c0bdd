"""Judge of readers: what may come of a mutated file is an error of ours or a right result."""

from __future__ import annotations

import os
import random
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

from predmapnet.errors import UserError
from tests.fuzzing.mutations import mutated
from tests.fuzzing.readers import Reader

SLOWEST = 10
"""Seconds that one input may take."""
MEMORY = 4 << 30
"""Bytes that it may take."""
STARTS = {
    "os.system",
    "os.exec",
    "os.fork",
    "os.posix_spawn",
    "subprocess.Popen",
    "pickle.find_class",
    "socket.connect",
}
"""What Python tells of code that data could start."""
TEMPORARY = Path(tempfile.gettempdir())
"""Asked for here, since the hook below may be called while Python looks for it."""
WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT

_watched: list[tuple[Path, list[str]]] = []


class TooSlowError(BaseException):
    """An input took too long; no reader may catch it."""


@dataclass
class Verdict:
    """What came of the inputs of a reader.

    Attributes:
        read, refused: numbers of inputs.
        seconds: of all.
        faults: what else happened, and the numbers of the inputs.
    """

    read: int = 0
    refused: int = 0
    seconds: float = 0.0
    faults: dict[str, list[int]] = field(default_factory=dict)

    def __str__(self) -> str:
        count = self.read + self.refused + sum(map(len, self.faults.values()))
        return f"{count} inputs: {self.refused} refused, {self.read} read, {count / self.seconds:.0f} a second"


def judge(reader: Reader, folder: Path, numbers: range, seed: int = 0) -> Verdict:
    """Read mutated files with a reader; the folder is empty.

    Each input depends on its number and the seed alone, so that it can be made again.
    """
    verdict = Verdict()
    files = {path: path.read_bytes() for path in reader.write(folder)}
    there = {path for path in folder.rglob("*") if path.is_file()}
    for path in files:  # As they are, all can be read.
        reader.read(folder, path)
    begun = time.perf_counter()
    with warnings.catch_warnings(), _limited_memory(), _watching(folder) as told:
        warnings.simplefilter("ignore")
        for number in numbers:
            generator = random.Random(f"{reader.name} {seed} {number}")
            path = generator.choice(list(files))
            others = [content for other, content in files.items() if other != path]
            path.write_bytes(mutated(path.suffix, files[path], others, generator))
            fault = _fault(reader, folder, path, verdict)
            if told:
                fault = f"{told[0]} ({fault})"
                told.clear()
            if fault is not None:
                verdict.faults.setdefault(fault, []).append(number)
            path.write_bytes(files[path])
    verdict.seconds = time.perf_counter() - begun
    left = {path for path in folder.rglob("*") if path.is_file()} - there
    if left - reader.written(folder):
        verdict.faults[f"files that nobody asked for: {sorted(left)[:3]}"] = []
    return verdict


def _fault(reader: Reader, folder: Path, path: Path, verdict: Verdict) -> str | None:
    """Read one input; return what went wrong, None if nothing did."""
    signal.setitimer(signal.ITIMER_REAL, SLOWEST)
    try:
        reader.read(folder, path)
        verdict.read += 1
    except UserError:
        verdict.refused += 1
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        calls = traceback.extract_tb(error.__traceback__)
        ours = next((call for call in reversed(calls) if _is_ours(call.filename)), calls[-1])
        return f"{type(error).__name__} at {Path(ours.filename).name}:{ours.lineno}: {str(error)[:120]}"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    return None


def _is_ours(file: str) -> bool:
    return any(f"/{package}/" in file for package in ("cli", "mapfusion", "predmapnet")) and "/tests/" not in file


@contextmanager
def _limited_memory() -> Iterator[None]:
    """Let memory end at MEMORY more than the process has; what wants more fails."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    size = (
        int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize() if sys.platform == "linux" else 0
    )
    resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, before[1]) if size else before)
    old = signal.signal(signal.SIGALRM, _too_slow)
    try:
        yield
    finally:
        signal.signal(signal.SIGALRM, old)
        resource.setrlimit(resource.RLIMIT_AS, before)


def _too_slow(number: int, frame: FrameType | None) -> None:
    raise TooSlowError(f"more than {SLOWEST} s")


@contextmanager
def _watching(folder: Path) -> Iterator[list[str]]:
    """Yield a list that names files that are written outside of a folder, and code that data starts."""
    if not _watched:
        sys.addaudithook(_audit)
    told: list[str] = []
    _watched.append((folder, told))
    if len(_watched) == 1:
        _watched.insert(0, (folder, []))  # a hook stays for good
    try:
        yield told
    finally:
        _watched.pop()


def _audit(event: str, arguments: tuple[Any, ...]) -> None:
    if len(_watched) < 2:
        return
    folder, told = _watched[-1]
    if event in STARTS:
        told.append(f"{event} {arguments!r:.100}")
    elif event == "open" and isinstance(arguments[0], str) and arguments[2] is not None and arguments[2] & WRITES:
        path = Path(arguments[0]).absolute()
        if not path.is_relative_to(folder) and path not in (Path(os.devnull), TEMPORARY):
            told.append(f"writes {arguments[0]}")
