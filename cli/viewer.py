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
from cli.web_server import DATA_PORT_OFFSET, HERE, serve_web
from predmapnet.errors import UserError
from predmapnet.files import check_output
from predmapnet.recording import APPLICATION, RecordingFile


@dataclass(frozen=True)
class WebOptions:
    """Address at which a viewer is served for web browsers.

    Attributes:
        bind: address to listen on.
        port: of the pages; the data are served on the next one.
    """

    bind: str = "127.0.0.1"
    port: int = 9090

    @property
    def address(self) -> str:
        """Address for a browser."""
        host = (
            "localhost" if self.bind in HERE else os.uname().nodename if self.bind in ("0.0.0.0", "::") else self.bind
        )
        data = urllib.parse.quote(f"rerun+http://{host}:{self.port + DATA_PORT_OFFSET}/proxy", safe="")
        return f"http://{host}:{self.port}?url={data}"

    def say(self) -> None:
        """Print how to look."""
        data, host = self.port + DATA_PORT_OFFSET, os.uname().nodename
        if self.bind in HERE:
            tunnel = f"ssh -L {self.port}:localhost:{self.port} -L {data}:localhost:{data} {host}"
            who = f"Only this machine can. From another one, first:  {tunnel}"
        else:
            who = f"Whoever reaches ports {self.port} and {data} of {self.bind} can look, too."
        out.print(f"Open {self.address} in a browser; stop with Ctrl-C.\n{who}", markup=False)


def has_display() -> bool:
    """Whether a window can be opened here."""
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


@contextlib.contextmanager
def open_viewer(
    name: str, web: WebOptions | None, file: Path | None, live: bool = False, quiet: bool = False
) -> Iterator[rr.RecordingStream]:
    """Yield a Rerun stream that shows on the web, in a file, or in a window if there is a display.

    Args:
        name: of the recording.
        web: serve it until Ctrl-C.
        file: write a recording here instead.
        live: whether there is something to watch before the block ends.
        quiet: leave it to the caller to say what was written.
    """
    recording = rr.RecordingStream(APPLICATION, recording_id=name)
    if web is not None:
        with _served(recording, web, live):
            yield recording
    elif file is None and has_display():
        recording.spawn()
        yield recording
        recording.flush()
    else:
        path = file or Path(f"{name}.rrd")
        check_output(path, (".rrd",))
        with RecordingFile(recording, path):
            yield recording
        if quiet:
            return
        if file is None:
            out.print("There is no display here, so the recording was written to a file.")
        out.print(f"written: {path}", markup=False)
        out.print(f"Look at it:  predmapnet view {path} --web   (or on your machine: rerun {path})", markup=False)


def show_file(path: Path, web: WebOptions | None) -> None:
    """Open a finished recording; without a display, print how to."""
    if not path.is_file():
        raise UserError(f"there is no recording {path}")
    if web is not None:
        recording = rr.RecordingStream(APPLICATION)
        with _served(recording, web):
            rr.log_file_from_path(path, recording=recording)
    elif has_display():
        subprocess.Popen([sys.executable, "-m", "rerun", str(path)], start_new_session=True)
    else:
        out.print(f"There is no display here. Look at it in a browser:  predmapnet view {path} --web", markup=False)
        out.print(f"or copy {path} to a machine with a display and run:  rerun {path.name}", markup=False)


@contextlib.contextmanager
def _served(recording: rr.RecordingStream, web: WebOptions, live: bool = False) -> Iterator[None]:
    """Serve what the block logs until Ctrl-C."""
    with serve_web(web.bind, web.port) as server:
        recording.connect_grpc(server.data_address)
        if live:
            web.say()
        try:
            yield
            with contextlib.suppress(KeyboardInterrupt):
                if not live:
                    web.say()
                while server.is_alive():
                    time.sleep(1.0)
        finally:
            recording.disconnect()  # before its server is gone
