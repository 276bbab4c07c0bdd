"""Folder that many workers write whole files to: on a disk, or in an object store by the URL that fsspec knows."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any

from predmapnet.errors import UserError
from predmapnet.files import check_output, write_file

AT_ONCE = 200
"""Objects that are read from a store together."""


@dataclass(frozen=True)
class OutputFolder:
    """Folder that many workers write to; a file appears whole under its name or not at all.

    Attributes:
        where: path, or URL (``s3://bucket/folder``).
    """

    where: str

    @classmethod
    def named(cls, text: str) -> OutputFolder:
        """Return the folder that a user names; paths become absolute, since workers may be elsewhere."""
        folder = cls(text)
        return folder if folder.path is None else cls(str(folder.path.expanduser().absolute()))

    @property
    def path(self) -> Path | None:
        """The folder, if it lies on a disk."""
        return None if re.match(r"[a-z][a-z0-9+.-]*://", self.where) else Path(self.where)

    def prepare(self) -> None:
        """Create the folder if need be, and check that files can be written there. Raises UserError."""
        if self.path is None:
            with self.write(".predmapnet") as trial:
                trial.write_bytes(b" ")
            self.remove(".predmapnet")
            return
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"cannot make the folder {self.path}: {(error.strerror or str(error)).lower()}") from error
        check_output(self.path / "summary.json")

    def names(self) -> set[str]:
        """Names of the files in it."""
        if self.path is not None:
            return {file.name for file in self.path.iterdir() if file.is_file()}
        store, root = self._store
        store.invalidate_cache()
        with _store_errors_told(self.where):
            try:
                return {PurePosixPath(name).name for name in store.ls(root, detail=False)} - {PurePosixPath(root).name}
            except FileNotFoundError:
                return set()

    def read(self, names: Iterable[str]) -> Iterator[tuple[str, bytes]]:
        """Yield names and contents of files that are there."""
        if self.path is not None:
            yield from ((name, (self.path / name).read_bytes()) for name in names)
            return
        store, root = self._store
        keys = [f"{root}/{name}" for name in names]
        for first in range(0, len(keys), AT_ONCE):
            with _store_errors_told(self.where):
                contents = store.cat(keys[first : first + AT_ONCE])
            yield from ((PurePosixPath(name).name, content) for name, content in contents.items())

    @contextmanager
    def write(self, name: str) -> Iterator[Path]:
        """Yield a temporary path that becomes the file if the block succeeds, as ``write_file`` does."""
        if self.path is not None:
            with write_file(self.path / name) as temporary:
                yield temporary
            return
        with self.staged() as folder:
            yield folder / name

    @contextmanager
    def staged(self) -> Iterator[Path]:
        """Yield a folder for whole files that are in this one once the block succeeds: itself, or one to upload."""
        if self.path is not None:
            yield self.path
            return
        store, root = self._store
        with tempfile.TemporaryDirectory(prefix="predmapnet-") as folder:
            yield Path(folder)
            for file in sorted(Path(folder).iterdir()):
                with _store_errors_told(f"{self.where}/{file.name}"):
                    store.put_file(str(file), f"{root}/{file.name}")

    def remove(self, name: str) -> None:
        """Remove a file, if it is there."""
        if self.path is not None:
            (self.path / name).unlink(missing_ok=True)
            return
        store, root = self._store
        with _store_errors_told(self.where), suppress(FileNotFoundError):
            store.rm_file(f"{root}/{name}")

    def remove_unfinished(self) -> None:
        """Remove files that were being written when a process was killed; stores keep none."""
        for leftover in self.path.glob(".*.part*") if self.path is not None else ():
            leftover.unlink(missing_ok=True)

    def link(self, name: str) -> str:
        """Return where a file lies, for people."""
        return str(self.path / name) if self.path is not None else f"{self.where.rstrip('/')}/{name}"

    @cached_property
    def _store(self) -> tuple[Any, str]:
        """The file system of the URL and the folder in it; made anew in each process."""
        import fsspec

        try:
            store, root = fsspec.core.url_to_fs(self.where)
        except ImportError as error:
            raise UserError(
                f"{self.where} needs a package that is not installed: {error}. For s3://, pip install 'predmapnet[s3]'"
            ) from error
        except ValueError as error:
            raise UserError(f"cannot write to {self.where}: {error}") from error
        return store, root.rstrip("/")

    def __getstate__(self) -> dict[str, str]:
        return {"where": self.where}


@contextmanager
def _store_errors_told(where: str) -> Iterator[None]:
    """Raise errors of an object store as UserErrors, except that a file is not there."""
    try:
        yield
    except FileNotFoundError:
        raise
    except Exception as error:
        raise UserError(f"cannot reach {where}: {error}") from error
