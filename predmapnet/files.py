"""Files that are either whole or not there: check before the work, write beside the target, rename at the end."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from predmapnet.errors import UserError


def check_output(path: Path) -> None:
    """Find out before the work begins whether a file can be written at ``path``.

    Raises:
        UserError: the folder does not exist or cannot be written to, or ``path`` is a folder itself.
    """
    if path.is_dir():
        raise UserError(f"cannot write to {path}: it is a folder; name a file, for example {path / 'map.geojson'}")
    folder = path.absolute().parent
    if not folder.exists():
        raise UserError(f"cannot write {path.name}: the folder {folder} does not exist; create it or choose another")
    if not folder.is_dir():
        raise UserError(f"cannot write {path.name}: {folder} is a file, not a folder")
    with write_whole(path, rename=False) as temporary:
        temporary.write_bytes(b" ")


@contextlib.contextmanager
def write_whole(path: Path, rename: bool = True) -> Iterator[Path]:
    """Yield a temporary name beside ``path``; rename it to ``path`` if the block succeeds, remove it if not.

    The content reaches the disk before the rename, so that not even a power cut leaves half a file.

    Args:
        path: the file to write; its folder exists.
        rename: False to try only, and leave nothing behind.

    Raises:
        UserError: the disk is full, or the folder does not allow it.
    """
    temporary = partial_name(path)
    try:
        yield temporary
        if rename:
            with temporary.open("rb") as file:
                os.fsync(file.fileno())
            temporary.replace(path)
    except OSError as error:
        raise UserError(f"cannot write {path}: {(error.strerror or str(error)).lower()}") from error
    finally:
        temporary.unlink(missing_ok=True)


def partial_name(path: Path) -> Path:
    """Name under which this process writes ``path`` before it is whole; ends in ``.part``."""
    return path.with_name(f".{path.name}.{os.getpid()}.part")
