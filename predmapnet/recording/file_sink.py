"""A recording file that notices a full disk.

Rerun's own file writer only prints such an error, and then blocks whoever goes on logging. So it writes into a pipe,
and a thread here carries the bytes to the disk: it keeps draining after an error, and the error is raised at the end.
"""

from __future__ import annotations

import os
import threading
from contextlib import ExitStack, nullcontext
from pathlib import Path
from types import TracebackType
from typing import Self

import rerun as rr

from mapfusion.files import write_whole
from predmapnet.files import write_errors_told


class RecordingFile:
    """File of a recording; it appears, whole, when the ``with`` block ends well."""

    def __init__(self, recording: rr.RecordingStream, path: Path) -> None:
        self._recording = recording
        self._path = path
        self._error: OSError | None = None
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        temporary = self._stack.enter_context(write_whole(self._path))
        source, target = os.pipe()
        self._pump = threading.Thread(target=self._carry, args=(source, temporary), daemon=True)
        self._pump.start()
        self._recording.set_sinks(rr.FileSink(f"/dev/fd/{target}"))
        os.close(target)
        return self

    def _carry(self, source: int, temporary: Path) -> None:
        with open(source, "rb", buffering=0) as pipe:
            try:
                with temporary.open("wb") as file:
                    while block := pipe.read(1 << 20):
                        file.write(block)
            except OSError as error:
                self._error = error
                while pipe.read(1 << 20):
                    pass

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._recording.disconnect()
        self._pump.join()
        failure = error or self._error
        with nullcontext() if error is not None else write_errors_told(self._path), self._stack:
            if failure is not None:
                raise failure
