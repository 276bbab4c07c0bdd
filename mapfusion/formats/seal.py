"""The seal of a map file: the SHA-256 of its content inside its provenance, by which a later edit shows.

A file is written with a seal of zeros, then hashed, and the zeros are replaced. Of a GeoPackage the tables are hashed,
because programs change its pages by opening it; of other formats the bytes, the seal and the time read as zeros.
"""

from __future__ import annotations

import hashlib
import re
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from mapfusion.files import write_whole

SEAL = "content_sha256"
UNSEALED = "0" * 64
_SEPARATORS = rb"(?:&quot;|[^0-9a-z])*"
_STORED = re.compile(SEAL.encode() + _SEPARATORS + rb"([0-9a-f]{64})")
_CREATED = re.compile(b"created" + _SEPARATORS + rb"(\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ)")
_OURS = (b"first_seen", b"observations", b"confidence")
"""Properties by which a map of ours is known that has lost its provenance."""


@contextmanager
def write_sealed(path: Path) -> Iterator[Path]:
    """Write a file as :func:`mapfusion.files.write_whole` does, and replace the zeros of its seal."""
    with write_whole(path) as temporary:
        yield temporary
        digest = _digest(temporary)
        if _is_database(temporary):
            with closing(sqlite3.connect(temporary)) as database:
                database.execute("UPDATE gpkg_metadata SET metadata = replace(metadata, ?, ?)", (UNSEALED, digest))
                database.commit()
        elif stored := _STORED.search(temporary.read_bytes()):
            with temporary.open("r+b") as file:
                file.seek(stored.start(1))
                file.write(digest.encode())


def edited_since_written(path: Path) -> bool:
    """Whether a file holds a map of ours that was changed after we wrote it, or that has lost its seal.

    False for a file that is none of ours.

    Raises:
        OSError: the file cannot be read.
    """
    try:
        stored = _STORED.search(_provenance(path))
        if stored is not None:
            return stored[1].decode() != _digest(path)
    except (sqlite3.Error, UnicodeDecodeError):  # a damaged database
        return False
    content = path.read_bytes()
    return all(name in content for name in _OURS)


def _provenance(path: Path) -> bytes:
    """Return the bytes in which the provenance stands."""
    if not _is_database(path):
        return path.read_bytes()
    with closing(_opened(path)) as database:
        return b"".join(text.encode() for (text,) in database.execute("SELECT metadata FROM gpkg_metadata"))


def _opened(path: Path) -> sqlite3.Connection:
    return sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)


def _is_database(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(16) == b"SQLite format 3\x00"


def _digest(path: Path) -> str:
    if not _is_database(path):
        content = bytearray(path.read_bytes())
        for pattern in (_STORED, _CREATED):
            if found := pattern.search(content):
                content[found.start(1) : found.end(1)] = b"0" * len(found[1])
        return hashlib.sha256(content).hexdigest()
    digest = hashlib.sha256()
    with closing(_opened(path)) as database:
        names = database.execute("SELECT name FROM sqlite_master WHERE type = 'table' ORDER BY name").fetchall()
        for (name,) in names:  # layers and styles, which people fill, not indexes and metadata
            if not name.startswith(("gpkg_", "rtree_", "sqlite_")):
                rows = database.execute(f'SELECT * FROM "{name}" ORDER BY 1')
                digest.update(repr([name, *(column[0] for column in rows.description)]).encode())
                for row in rows:
                    digest.update(repr(row).encode())
    return digest.hexdigest()
