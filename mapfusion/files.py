"""Files that are written whole: complete under their name, or not there at all."""

from __future__ import annotations

import errno
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def write_whole(path: Path) -> Iterator[Path]:
    """Yield a temporary name beside ``path`` that becomes the file if the block succeeds, and vanishes if not.

    The content reaches the disk before the rename, so that not even a power cut leaves half a file. The temporary name
    has the ending of ``path``, since some writers choose the format by it. The folder has to exist.

    Raises:
        OSError: the file cannot be written, or another program has it open.
    """
    path = target_of(path)
    _refuse_open_file(path)
    temporary = path.with_name(f".{secrets.token_hex(4)}.part{path.suffix}")
    try:
        yield temporary
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        _refuse_open_file(path)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def target_of(path: Path) -> Path:
    """Return the path, or the file that it names if it is a link: links stay where they are.

    Raises:
        OSError: links that lead in a circle.
    """
    found = Path(os.path.realpath(path)) if path.is_symlink() else path
    if found.is_symlink():
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(path))
    return found


def companion_of_open_file(path: Path) -> Path | None:
    """Return the file beside ``path`` that tells that another program has it open; None if there is none.

    A program that has a GeoPackage open keeps changes in ``-wal`` or ``-journal`` beside it. SQLite would apply them to
    whatever file has that name, so a new one must not take its place. Locks of other programs count, too.
    """
    beside = [Path(f"{path}{ending}") for ending in ("-wal", "-journal", "-shm")]
    locks = [path.with_name(f".~lock.{path.name}#"), Path(f"{path}.lock"), path.with_name(f".{path.name}.lock")]
    full = (companion for companion in beside if companion.is_file() and companion.stat().st_size > 0)
    return next(full, None) or next((lock for lock in locks if lock.exists() or lock.is_symlink()), None)


def _refuse_open_file(path: Path) -> None:
    companion = companion_of_open_file(path)
    if companion is not None:
        raise OSError(errno.EBUSY, f"another program has it open ({companion} is there); close it there", str(path))
