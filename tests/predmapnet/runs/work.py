"""Work for executors that counts, dies, sleeps or refuses, in processes that import it by name."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from predmapnet.errors import UserError


@dataclass(frozen=True)
class Notebook:
    """Work that does what a task says and notes each try in a folder: square 3, die, die once, sleep, refuse."""

    folder: Path

    def __call__(self) -> Callable[[str], tuple[int, int | None]]:
        """Note the beginning of a worker."""
        (self.folder / f"begun-{os.getpid()}").touch()
        return self.work

    def work(self, task: str) -> tuple[int, int | None]:
        """Do one task; returns the process and the result."""
        with (self.folder / f"{task}.tries").open("a") as tries:
            tries.write(f"{os.getpid()}\n")
        if task == "die" or (task == "die once" and len(self.tries(task)) == 1):
            os.kill(os.getpid(), signal.SIGKILL)
        if task == "sleep":
            time.sleep(600)
        if task == "refuse":
            raise UserError("it refuses")
        return os.getpid(), int(task.split()[1]) ** 2 if task.startswith("square") else None

    def tries(self, task: str) -> list[str]:
        """Processes that tried a task."""
        return (self.folder / f"{task}.tries").read_text().split()

    def begun(self) -> int:
        """Number of workers that began."""
        return len(list(self.folder.glob("begun-*")))


@dataclass(frozen=True)
class Unfit:
    """Work that no worker can begin."""

    def __call__(self) -> Callable[[str], None]:
        """Refuse to begin."""
        raise UserError("there are no weights here")


@dataclass(frozen=True)
class Stillborn:
    """Work whose first worker dies while it begins, by a folder that remembers."""

    folder: Path

    def __call__(self) -> Callable[[str], str]:
        """Die, or begin."""
        if not (self.folder / "died").exists():
            (self.folder / "died").touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return str.upper


@dataclass(frozen=True)
class Niceness:
    """Work that tells how much its worker gives way to other processes."""

    def __call__(self) -> Callable[[str], int]:
        """Nothing to open."""
        return lambda task: os.nice(0)
