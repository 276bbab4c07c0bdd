"""``predmapnet view --web``: who can look, ports in use, and servers that end with the command and idle quietly."""

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from mapfusion import ElementKind, GlobalMap, MapElement
from mapfusion.formats.by_suffix import write_map
from mapfusion.formats.local_plane import LocalPlane
from tests.interrupts import heed_interrupts

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="looks at processes in /proc")


def free_ports() -> int:
    """Return the first of two free ports in a row."""
    for port in range(20000 + os.getpid() % 20000, 65000, 2):
        with socket.socket() as first, socket.socket() as second:
            try:
                first.bind(("127.0.0.1", port))
                second.bind(("127.0.0.1", port + 1))
            except OSError:
                continue
            return port
    raise AssertionError("no free ports")


@pytest.fixture
def street(tmp_path) -> Path:
    line = MapElement(ElementKind.DIVIDER, np.array([[0.0, 0.0], [80.0, 0.0]]), 0.9, 8, 10**18, 10**18 + 1)
    write_map(GlobalMap((line,)), tmp_path / "street.geojson", LocalPlane(8.4, 49.0))
    return tmp_path / "street.geojson"


def answers(port: int, host: str = "127.0.0.1") -> bool:
    try:
        socket.create_connection((host, port), timeout=1.0).close()
    except OSError:
        return False
    return True


def wait_until(condition, seconds: float = 90.0) -> bool:
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if condition():
            return True
        time.sleep(0.1)
    return False


def served(what: Path, port: int, *options: str) -> subprocess.Popen:
    command = [sys.executable, "-m", "cli.main", "view", str(what), "--web", "--port", str(port), *options]
    pipe = subprocess.PIPE
    process = subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, preexec_fn=heed_interrupts)
    first = process.stdout.readline()  # comes when everything is drawn
    assert first.startswith("Open http://"), process.stderr.read()
    return process


def listening_addresses(port: int) -> set[str]:
    table = Path("/proc/net/tcp").read_text().splitlines()[1:]
    rows = [line.split() for line in table]
    return {
        local.split(":")[0] for _, local, _, state, *_ in rows if int(local.split(":")[1], 16) == port and state == "0A"
    }


def cpu_ticks(port: int) -> int:
    """Processor time of the server that serves a port."""
    total = 0
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            words = (folder / "cmdline").read_bytes().split(b"\0")
            if b"--web-viewer-port" in words and str(port).encode() in words:
                numbers = (folder / "stat").read_text().rsplit(")", 1)[1].split()
                total += int(numbers[11]) + int(numbers[12])
        except OSError:
            continue
    return total


@LINUX
@pytest.mark.parametrize("kind", ["map", "recording"])
def test_only_this_machine_can_look_and_the_servers_idle_and_end_with_the_command(predmapnet, street, tmp_path, kind):
    what = street
    if kind == "recording":
        what = tmp_path / "street.rrd"
        assert predmapnet("view", street, "--out", what).code == 0
    port = free_ports()
    process = served(what, port)
    try:
        assert listening_addresses(port) == listening_addresses(port + 1) == {"0100007F"}
        time.sleep(2.0)
        before = cpu_ticks(port)
        time.sleep(3.0)
        assert cpu_ticks(port) - before <= 0.3 * 3.0 * os.sysconf("SC_CLK_TCK")
    finally:
        process.kill()  # not even the command can clean up
    process.wait(60)
    said = process.stdout.read()
    assert f"ssh -L {port}:localhost:{port} -L {port + 1}:localhost:{port + 1}" in said
    assert wait_until(lambda: not answers(port) and not answers(port + 1), 20.0)


def test_others_can_look_if_they_are_let_and_ctrl_c_ends_it_without_an_error(street):
    port = free_ports()
    process = served(street, port, "--bind", "0.0.0.0")
    found = listening_addresses(port) if sys.platform == "linux" else {"00000000"}
    process.send_signal(signal.SIGINT)
    process.wait(60)
    said, complaints = process.stdout.read(), process.stderr.read()
    assert found == {"00000000"}
    assert "can look, too" in said
    assert (process.returncode, complaints) == (0, "")
    assert wait_until(lambda: not answers(port), 20.0)


@pytest.mark.parametrize("taken", [0, 1])
def test_a_port_in_use_is_one_message(predmapnet, street, taken):
    port = free_ports()
    with socket.socket() as other:
        other.bind(("127.0.0.1", port + taken))
        other.listen()
        result = predmapnet("view", street, "--web", "--port", port)
    assert result.code == 2
    assert f"port {port + taken} of 127.0.0.1" in result.err
    assert "--port" in result.err
    assert len(result.err.strip().splitlines()) == 1


def test_an_address_of_another_machine_is_one_message(predmapnet, street):
    result = predmapnet("view", street, "--web", "--bind", "192.0.2.1", "--port", free_ports())
    assert result.code == 2
    assert "192.0.2.1" in result.err
