"""Viewers of recordings: a window, a web browser, or a file for later."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
import urllib.parse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import rerun as rr

from cli.console import out
from predmapnet.errors import UserError
from predmapnet.files import check_output
from predmapnet.recording import APPLICATION, RecordingFile

GRPC_PORT_OFFSET = 1
"""The data behind a web viewer is served on the port after the viewer's own."""


def web_address(port: int) -> str:
    """Return the address of a web viewer and its data."""
    data = urllib.parse.quote(f"rerun+http://localhost:{port + GRPC_PORT_OFFSET}/proxy", safe="")
    return f"http://localhost:{port}?url={data}"


def has_display() -> bool:
    """Whether a window can be opened here."""
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


@dataclass(frozen=True)
class Viewer:
    """An open viewer.

    Attributes:
        recording: the Rerun stream to log into.
    """

    recording: rr.RecordingStream

    @classmethod
    @contextlib.contextmanager
    def open(cls, name: str, web: bool, port: int, file: Path | None, live: bool) -> Iterator[Viewer]:
        """Open a viewer for the block: on the web, in a file, or in a window if there is a display.

        Args:
            name: of the recording.
            web: serve on ``port`` until Ctrl-C.
            port: of the web viewer.
            file: write a recording here instead.
            live: whether there is something to watch before the block ends.
        """
        recording = rr.RecordingStream(APPLICATION, recording_id=name)
        if web:
            server = recording.serve_grpc(grpc_port=port + GRPC_PORT_OFFSET)
            rr.serve_web_viewer(web_port=port, open_browser=False, connect_to=server)
            if live:
                out.print(f"Open {web_address(port)} in a browser to watch.", markup=False)
            yield cls(recording)
            out.print(f"Open {web_address(port)} in a browser; stop with Ctrl-C.", markup=False)
            with contextlib.suppress(KeyboardInterrupt):
                while True:
                    time.sleep(3600)
        elif file is None and has_display():
            recording.spawn()
            yield cls(recording)
            recording.flush()
        else:
            path = file or Path(f"{name}.rrd")
            check_output(path)
            with RecordingFile(recording, path):
                yield cls(recording)
            if file is None:
                out.print("There is no display here, so the recording was written to a file.")
            out.print(f"written: {path}", markup=False)
            out.print(f"Look at it:  predmapnet view {path} --web   (or on your machine: rerun {path})", markup=False)

    @staticmethod
    def show_file(path: Path, web: bool, port: int) -> None:
        """Open a finished recording; without a display, print how to."""
        if not path.is_file():
            raise UserError(f"there is no recording {path}")
        command = [sys.executable, "-m", "rerun", str(path)]
        if web:
            out.print(f"Open {web_address(port)} in a browser; stop with Ctrl-C.", markup=False)
            ports = ["--web-viewer-port", str(port), "--port", str(port + GRPC_PORT_OFFSET)]
            with contextlib.suppress(KeyboardInterrupt):
                raise SystemExit(subprocess.call([*command, "--serve-web", *ports]))
            return
        if has_display():
            subprocess.Popen(command, start_new_session=True)
            return
        out.print(f"There is no display here. Look at it in a browser:  predmapnet view {path} --web", markup=False)
        out.print(f"or copy {path} to a machine with a display and run:  rerun {path.name}", markup=False)
