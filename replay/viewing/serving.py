"""Serving a recording to web browsers, by the server that comes with rerun's viewer, as a process of its own.

The server that rerun's Python interface starts listens on every address of the machine; this one listens on one.
"""

from __future__ import annotations

import importlib.util
import os
import re
import socket
import subprocess
import sys
import threading
import weakref
from dataclasses import dataclass
from ipaddress import IPv6Address, ip_address
from pathlib import Path
from typing import IO
from urllib.parse import quote

from prim.errors import PrimError
from replay.viewing.checks import PORTS_TRIED, find_free_ports, local_address

PORTS = 9876, 9090
"""Where the recording and the viewer's page are served, or at the next ports that are both free."""

START_SECONDS = 30.0
"""The server must listen within this time (s); set by hand, it takes some tenths of a second."""

ELSEWHERE = ("198.51.100.1", 9)
"""An address of another network (RFC 5737), to which nothing is sent."""

EXECUTABLES = ("rerun", "rerun.exe", "Rerun.app/Contents/MacOS/Rerun")
"""Where rerun's packages have the executable, beside the module rerun_cli."""

SETTINGS = {"CI": "true", "TELEMETRY_ENABLED": "false", "NO_COLOR": "1", "RUST_LOG": "warn,re_sdk=info"}
"""The server's own environment: rerun sends no usage data where CI is set, and writes nothing into the home."""

FORCED = "FORCE_RERUN_ANALYTICS"

LISTENING = "Hosting a web-viewer at"
"""What the server writes when it listens on both ports."""

PREFIX = re.compile(r"^\S+Z\s+[A-Z]+\s+\S+:\s+|^Error: ")
"""Time, level and module before what the server reports."""

ESCAPES = re.compile(r"\x1b\[[0-9;]*[A-Za-z]|[\x00-\x1f\x7f-\x9f]")

END_WITH_PARENT = """\
import ctypes, os, sys
ctypes.CDLL(None).prctl(1, 9)  # PR_SET_PDEATHSIG, SIGKILL
if os.getppid() == int(sys.argv[1]):
    os.execv(sys.argv[2], sys.argv[2:])
"""
"""Run a command that Linux kills when the process that started it ends, however that ends."""


class ServingError(PrimError):
    """The server that browsers connect to could not be started."""


@dataclass(frozen=True)
class ServedAddresses:
    """Where a recording is served.

    Attributes:
        address: The IP address that the server listens on; 0.0.0.0 and :: are all of the machine.
        grpc_port: The port of the recording.
        web_port: The port of the viewer's page.
    """

    address: str
    grpc_port: int
    web_port: int

    @property
    def recording(self) -> str:
        """The recording's URL for this process and others of this machine."""
        return _recording_url(_loopback(self.address) if self._on_all else self.address, self.grpc_port)

    @property
    def announced(self) -> tuple[str, str]:
        """The URLs of the page and of the recording, for everybody who can reach them."""
        name = self._names[0]
        url = _recording_url(name, self.grpc_port)
        return f"{_origin(name, self.web_port)}/?url={quote(url, safe='')}", url

    @property
    def origins(self) -> list[str]:
        """The origins of the page, from which a browser may ask for the recording."""
        return [_origin(name, self.web_port) for name in self._names]

    @property
    def _on_all(self) -> bool:
        return ip_address(self.address).is_unspecified

    @property
    def _names(self) -> list[str]:
        """The names that the server is reached by, best first."""
        if not self._on_all:
            return [self.address]
        name = socket.gethostname()
        return [*_outward_address(), name, f"{name}.local"]


class RecordingServer:
    """Serves what is sent to it to browsers and viewers, also to those that come later, until it is closed.

    It ends with this process: on Linux however that ends, elsewhere unless that is killed.

    Args:
        host: The address or the name of this machine to listen on; 0.0.0.0 is every address.

    Raises:
        UsageError: The host is none of this machine, or no port is free.
        ServingError: The server cannot be started.
    """

    def __init__(self, host: str) -> None:
        address = local_address(host)
        self.addresses = _free_addresses(address)
        for _ in range(PORTS_TRIED):
            process = _ServerProcess(self.addresses)
            if process.listens:
                break
            failed, self.addresses = self.addresses, _free_addresses(address)
            if failed == self.addresses:  # else another program was faster
                raise ServingError(f"--serve: rerun's server did not start: {process.report}")
        self.close = weakref.finalize(self, process.end)
        """End the server; called by itself where it has not been."""


class _ServerProcess:
    """The server's process, once it listens or has failed."""

    def __init__(self, addresses: ServedAddresses) -> None:
        self.listens = False
        self.report = ""
        self._started = threading.Event()
        environment = {name: value for name, value in os.environ.items() if name != FORCED} | SETTINGS
        try:
            self._process = subprocess.Popen(
                _command(addresses),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                encoding="utf-8",
                errors="replace",
                env=environment,
                start_new_session=True,  # Ctrl-C is for this process, which then ends the server
            )
        except OSError as error:
            raise ServingError(f"--serve: rerun's server did not start: {error}") from error
        try:
            self._await()
        finally:
            if not self.listens:
                self.end()

    def end(self) -> None:
        """End the server."""
        self._process.kill()
        self._process.wait()

    def _await(self) -> None:
        """Wait until the server listens or has failed."""
        threading.Thread(target=self._read, args=(self._process.stdout,), daemon=True).start()
        if not self._started.wait(START_SECONDS):
            self.report = f"it does not listen after {START_SECONDS:.0f} s"

    def _read(self, output: IO[str]) -> None:
        """Read what the server writes, to the end: it would wait for a reader otherwise."""
        with output:
            for line in output:
                if LISTENING in line:
                    self.listens = True
                    self._started.set()
                elif text := PREFIX.sub("", ESCAPES.sub("", line)).strip():
                    self.report = text
        self.report = self.report or "it ended at once"
        self._started.set()


def _free_addresses(address: str) -> ServedAddresses:
    return ServedAddresses(address, *find_free_ports(PORTS, address))


def _command(addresses: ServedAddresses) -> list[str]:
    """Return the command that starts the server."""
    command = [str(_executable()), "--serve-web", "--bind", addresses.address]
    command += ["--port", str(addresses.grpc_port), "--web-viewer-port", str(addresses.web_port)]
    for origin in addresses.origins:
        command += ["--cors-allow-origin", origin]
    if sys.platform == "linux":
        return [sys.executable, "-I", "-S", "-c", END_WITH_PARENT, str(os.getpid()), *command]
    return command


def _executable() -> Path:
    """Return rerun's executable. Raises ServingError where there is none."""
    module = importlib.util.find_spec("rerun_cli")
    folder = Path(module.origin).parent if module and module.origin else Path()
    found = [folder / name for name in EXECUTABLES if (folder / name).is_file()] if module else []
    if not found:
        raise ServingError("--serve needs the executable that rerun-sdk brings, and it is missing: install it anew")
    return found[0]


def _outward_address() -> list[str]:
    """Return the IPv4 address by which this machine reaches others, if it has one. Nothing is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(ELSEWHERE)
        except OSError:
            return []
        return [str(probe.getsockname()[0])]


def _loopback(address: str) -> str:
    return "::1" if isinstance(ip_address(address), IPv6Address) else "127.0.0.1"


def _recording_url(host: str, port: int) -> str:
    return f"rerun+http://{_bracketed(host)}:{port}/proxy"


def _origin(host: str, port: int) -> str:
    return f"http://{_bracketed(host)}:{port}"


def _bracketed(host: str) -> str:
    """Return a host as URLs have it: IPv6 addresses in brackets."""
    return f"[{host}]" if ":" in host else host
