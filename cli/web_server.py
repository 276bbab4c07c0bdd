"""Rerun's web viewer and the server of its data, as a process that ends with this one, however that ends."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass

from predmapnet.errors import UserError

DATA_PORT_OFFSET = 1
"""The data behind a web viewer are served on the port after the viewer's own."""

START_SECONDS = 60.0

GUARD = '("$@"; kill 0) & cat > /dev/null; kill 0'
"""Shell that runs a command until it or the shell's own input ends, and then ends its process group."""

HERE = ("127.0.0.1", "::1", "localhost")
"""Addresses that only this machine reaches."""


@dataclass(frozen=True)
class WebServer:
    """A running server.

    Attributes:
        data_address: where a Rerun stream connects to.
    """

    data_address: str
    _process: subprocess.Popen[bytes]

    def is_alive(self) -> bool:
        """Whether it still runs."""
        return self._process.poll() is None


@contextlib.contextmanager
def serve_web(bind: str, port: int) -> Iterator[WebServer]:
    """Serve a web viewer for the block.

    The server is Rerun's own command without any data, to which a stream connects: given a file, it would burn a core
    while idle, and the server inside the SDK listens on all interfaces.

    Args:
        bind: address to listen on.
        port: of the pages; data on the next one.

    Raises:
        UserError: a port is in use, the address is not one of this machine, or the server does not start.
    """
    for one in (port, port + DATA_PORT_OFFSET):
        _check_free(bind, one)
    command = [sys.executable, "-m", "rerun_cli", "--serve-web", "--bind", bind, "--web-viewer-port", str(port)]
    command += ["--port", str(port + DATA_PORT_OFFSET), "--server-memory-limit", "75%"]
    if bind not in HERE:  # browsers that reach the page may read its data
        command += ["--cors-allow-origin", f"http://*:{port}"]
    with tempfile.TemporaryFile() as log:
        process = subprocess.Popen(
            ["sh", "-c", GUARD, "sh", *command], stdin=subprocess.PIPE, stdout=log, stderr=log, start_new_session=True
        )
        try:
            host = bind if bind not in ("0.0.0.0", "::") else "127.0.0.1"
            _wait(process, host, (port, port + DATA_PORT_OFFSET), log.fileno())
            yield WebServer(f"rerun+http://{host}:{port + DATA_PORT_OFFSET}/proxy", process)
        finally:
            process.stdin.close()  # type: ignore[union-attr]
            process.wait()


def _check_free(bind: str, port: int) -> None:
    with socket.socket(socket.AF_INET6 if ":" in bind else socket.AF_INET) as trial:
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind((bind, port))
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise UserError(
                f"cannot listen on port {port} of {bind}: {reason.lower()}. The viewer needs two ports in a row: "
                "choose others with --port"
            ) from error


def _wait(process: subprocess.Popen[bytes], host: str, ports: tuple[int, ...], log: int) -> None:
    """Wait until all ports answer. Raises UserError, with what the server said, if they do not."""
    deadline = time.monotonic() + START_SECONDS
    for port in ports:
        while True:
            with contextlib.suppress(OSError), socket.create_connection((host, port), timeout=1.0):
                break
            if process.poll() is not None or time.monotonic() > deadline:
                said = os.pread(log, 4000, 0).decode(errors="replace").strip()
                raise UserError(f"the web viewer did not start: {said or 'it said nothing'}")
            time.sleep(0.05)
