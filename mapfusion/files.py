"""Files that are written whole: complete under their name, or not there at all."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def write_whole(path: Path) -> Iterator[Path]:
    """Yield a temporary name beside ``path`` that becomes the file if the block succeeds, and vanishes if not.

    The content reaches the disk before the rename, so that not even a power cut leaves half a file. The temporary name
    has the ending of ``path``, since some writers choose the format by it.

    Args:
        path: file to write; its folder exists, and a file that is there already is replaced.

    Raises:
        OSError: the file cannot be written.
    """
    temporary = path.with_name(f".{secrets.token_hex(4)}.part{path.suffix}")
    try:
        yield temporary
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
