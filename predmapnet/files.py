"""Output files for users: checked before the work, written whole, and failures told as messages."""

from __future__ import annotations

import contextlib
import hashlib
import re
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import mapfusion.files
from mapfusion.formats.by_suffix import map_suffix
from mapfusion.formats.seal import edited_since_written
from predmapnet.errors import UserError


def check_output(path: Path, endings: tuple[str, ...] = (), inputs: Sequence[Path] = (), force: bool = False) -> None:
    """Check before the work begins that a file can be written at ``path``.

    Args:
        path: of the file.
        endings: those that the name may have, in lower case; all without.
        inputs: files that are read, and must not be lost.
        force: replace a map that was changed since we wrote it.

    Raises:
        UserError: the folder does not exist or cannot be written to, ``path`` is a folder itself or an input, it holds
            a map that somebody has changed, or another program has it open.
    """
    if endings and path.suffix.lower() not in endings:
        raise UserError(f"cannot write {path}: only {' or '.join(endings)} can be written there, not '{path.suffix}'")
    if path.is_dir():
        raise UserError(f"cannot write to {path}: it is a folder; name a file, for example {path / 'map.geojson'}")
    folder = path.absolute().parent
    if not folder.exists():
        raise UserError(f"cannot write {path.name}: the folder {folder} does not exist; create it or choose another")
    if not folder.is_dir():
        raise UserError(f"cannot write {path.name}: {folder} is a file, not a folder")
    if path.exists():
        _check_loss(path, inputs, force)
    companion = mapfusion.files.companion_of_open_file(mapfusion.files.target_of(path))
    if companion is not None:
        raise UserError(
            f"cannot write {path}: another program (QGIS, for example) has it open, since {companion} is there. Close "
            f"it there, or choose another name; if no program has it open, delete {companion.name} first"
        )
    with write_errors_told(path), tempfile.NamedTemporaryFile(dir=folder, prefix=".", suffix=".part") as trial:
        trial.write(b" ")


def _check_loss(path: Path, inputs: Sequence[Path], force: bool) -> None:
    """Raise UserError if writing to a file that exists would lose what nobody can make again."""
    if any(given.exists() and given.samefile(path) for given in inputs):
        raise UserError(f"cannot write {path}: it is an input, too, and would be lost; choose another name")
    if not force and map_suffix(path) and edited_since_written(path):
        raise UserError(
            f"cannot write {path}: the map in it was changed after PredMapNet wrote it, by hand or by another program, "
            "and these changes would be lost. Choose another name, or add --force"
        )


@contextlib.contextmanager
def write_file(path: Path) -> Iterator[Path]:
    """Write ``path`` as :func:`mapfusion.files.write_whole` does, but raise UserError if that fails."""
    with write_errors_told(path), mapfusion.files.write_whole(path) as temporary:
        yield temporary


@contextlib.contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """Yield a new folder beside ``path`` that gets its name if the block succeeds, and vanishes if not.

    Raises:
        UserError: ``path`` exists already, or cannot be written.
    """
    if path.exists() or path.is_symlink():
        raise UserError(f"{path} exists already. Choose another name, or delete it first.")
    with write_errors_told(path):
        path.absolute().parent.mkdir(parents=True, exist_ok=True)
        draft = Path(tempfile.mkdtemp(dir=path.absolute().parent, prefix=f".{path.name}.", suffix=".part"))
        try:
            yield draft
            draft.chmod(0o755)
            draft.rename(path)
        finally:
            shutil.rmtree(draft, ignore_errors=True)


@contextlib.contextmanager
def write_errors_told(path: Path) -> Iterator[None]:
    """Raise OSErrors of the block as UserErrors that name ``path``."""
    try:
        yield
    except OSError as error:
        raise UserError(f"cannot write {path}: {(error.strerror or str(error)).lower()}") from error


def file_name(name: str) -> str:
    """Return a name that data brings (of a scene, for example) as one that is safe for a file.

    Names of letters, digits, blanks and ``._+@()-`` stay as they are, unless they begin with a dot or are longer than
    150 characters. In others, what is not safe becomes ``_``, and a digest keeps different names apart.
    """
    safe = re.sub(r"[^\w .+@()-]", "_", name)
    safe = re.sub(r"^[. ]+|[. ]+$", "_", safe)[:150] or "_"
    digest = hashlib.sha256(name.encode(errors="surrogatepass")).hexdigest()[:8]
    return name if safe == name else f"{safe}-{digest}"
