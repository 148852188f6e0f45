"""Where a served replay listens, and that it ends with the command."""

import http.client
import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest

from prim.errors import UsageError
from recorder.session import Session
from replay.options import ReplayOptions
from replay.pipeline import Pipeline
from replay.viewer import RerunViewer
from replay.viewing import serving
from replay.viewing.checks import local_address
from replay.viewing.protocol import ViewerOptions
from replay.viewing.serving import END_WITH_PARENT, RecordingServer, ServedAddresses, ServingError

ROOT = Path(__file__).parents[3]


def test_only_addresses_of_this_machine_are_served() -> None:
    assert local_address("127.0.0.2") == "127.0.0.2"
    for host in ("198.51.100.7", "", "no such host"):
        with pytest.raises(UsageError, match="--serve-host"):
            local_address(host)
    with pytest.raises(UsageError, match="--serve-host"):
        RerunViewer(ViewerOptions(serve=True, serve_host="198.51.100.7"), print)
    with pytest.raises(UsageError, match="--serve-host goes with --serve"):
        ViewerOptions(serve_host="127.0.0.1")


def listening(port: int) -> set[str]:
    """The IPv4 addresses (as the kernel lists them) and v6 markers on which something listens at a port."""
    found = set()
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            address, state = line.split()[1], line.split()[3]
            if state == "0A" and int(address.split(":")[1], 16) == port:
                found.add(address.split(":")[0])
    return found


def with_home(home: Path) -> dict[str, str]:
    """An environment in which rerun reports its usage and logs nothing, unless the server sets it otherwise."""
    kept = {name: value for name, value in os.environ.items() if name != "CI" and not name.startswith("XDG_")}
    return kept | {"HOME": str(home), "FORCE_RERUN_ANALYTICS": "1", "RUST_LOG": "off"}


def test_the_page_alone_may_ask_for_the_recording() -> None:
    """A browser lets a page of another site read only what the server allows it to (CORS).

    Pages of 127.0.0.1 it always allows, whoever serves them.
    """
    server = RecordingServer("127.0.0.2")
    page = f"http://127.0.0.2:{server.addresses.web_port}"
    for origin, allowed in ((page, page), ("http://another.example", None)):
        connection = http.client.HTTPConnection("127.0.0.2", server.addresses.grpc_port, timeout=10)
        headers = {"Origin": origin, "Access-Control-Request-Method": "POST"}
        connection.request("OPTIONS", "/", headers=headers)
        assert connection.getresponse().headers["access-control-allow-origin"] == allowed
        connection.close()
    server.close()


@pytest.mark.skipif(sys.platform != "linux", reason="as Linux does it")
def test_no_server_starts_for_a_process_that_has_ended() -> None:
    command = [sys.executable, "-c", END_WITH_PARENT, "0", sys.executable, "-c", "print('started')"]
    assert subprocess.run(command, capture_output=True, check=True).stdout == b""


def test_why_a_server_does_not_start_is_told_in_plain_text(monkeypatch: pytest.MonkeyPatch) -> None:
    code = r"print('2026-11-27T15:00:00.0Z ERROR re_grpc: \x1b[31mno\x07 place\x1b[0m')"
    monkeypatch.setattr(serving, "_command", lambda addresses: [sys.executable, "-c", code])
    with pytest.raises(ServingError, match=r"rerun's server did not start: no place$"):
        RecordingServer("127.0.0.1")


def test_ports_that_another_program_is_faster_to_take_are_left_to_it(monkeypatch: pytest.MonkeyPatch) -> None:
    command, others = serving._command, []

    def take_port(addresses: ServedAddresses) -> list[str]:
        if not others:
            others.append(socket.create_server((addresses.address, addresses.grpc_port)))
        return command(addresses)

    monkeypatch.setattr(serving, "_command", take_port)
    server = RecordingServer("127.0.0.1")
    assert server.addresses.grpc_port != others[0].getsockname()[1]
    server.close()
    others[0].close()


def test_the_server_is_not_interrupted_by_a_terminal() -> None:
    """Ctrl-C reaches all processes of a group, and what is left of the recording is still to be sent."""
    code = """\
import os, signal, socket, sys, time
sys.path.insert(0, sys.argv[1])
from replay.viewing.serving import RecordingServer
server = RecordingServer("127.0.0.1")
signal.signal(signal.SIGINT, lambda number, frame: None)
os.killpg(0, signal.SIGINT)
time.sleep(1.0)
socket.create_connection(("127.0.0.1", server.addresses.grpc_port), timeout=5)
"""
    found = subprocess.run(
        [sys.executable, "-c", code, str(ROOT)], start_new_session=True, capture_output=True, text=True, timeout=60
    )
    assert found.returncode == 0, found.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="reads the kernel's table of sockets")
def test_a_replay_that_fails_is_served_no_longer(noisy_session: Session) -> None:
    lines: list[str] = []

    def fail(stage: str, done: int, total: int) -> None:
        raise ZeroDivisionError

    viewer = RerunViewer(ViewerOptions(serve=True), lines.append)
    with pytest.raises(ZeroDivisionError):
        Pipeline(noisy_session.path, ReplayOptions(detect=False), viewer, fail).run()
    port = int(lines[0].partition("browse: http://127.0.0.1:")[2].partition("/")[0])
    assert listening(port) == set()


@pytest.mark.skipif(sys.platform != "linux", reason="reads the kernel's table of sockets")
@pytest.mark.parametrize(("number", "exit_code"), [(signal.SIGINT, 0), (signal.SIGKILL, -9)])
def test_a_replay_is_served_on_loopback_until_it_ends(
    tmp_path: Path, noisy_session: Session, number: int, exit_code: int, request: pytest.FixtureRequest
) -> None:
    code = f"import sys; sys.path.insert(0, {str(ROOT)!r}); from replay.__main__ import main; main()"
    command = [sys.executable, "-c", code, str(noisy_session.path), "--serve", "--no-detect"]
    home = tmp_path / "home"
    home.mkdir()
    process = subprocess.Popen(
        command,
        cwd=tmp_path,
        env=with_home(home),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    request.addfinalizer(process.kill)  # where a check fails
    assert process.stderr is not None
    lines: list[str] = []
    while not any("still served" in line for line in lines) and (line := process.stderr.readline()):
        lines.append(line)
    found = re.match(
        r"browse: http://127\.0\.0\.1:(\d+)/.*\nor:     rerun rerun\+http://127\.0\.0\.1:(\d+)/", "".join(lines)
    )
    assert found is not None, lines
    ports = [int(port) for port in found.groups()]
    assert [listening(port) for port in ports] == [{"0100007F"}] * 2
    with urllib.request.urlopen(f"http://127.0.0.1:{ports[0]}/", timeout=10) as page:
        assert b"rerun" in page.read().lower()
    process.send_signal(number)
    process.communicate(timeout=20)
    assert process.returncode == exit_code
    for _ in range(100):
        if not any(listening(port) for port in ports):
            break
        time.sleep(0.1)
    assert [listening(port) for port in ports] == [set()] * 2
    assert not list(home.iterdir())  # where rerun keeps the id of a user whose usage it reports
