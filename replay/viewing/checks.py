"""Checks before a recording is sent: rerun itself would wait, lose everything, and report nothing."""

from __future__ import annotations

import os
import socket
from pathlib import Path
from urllib.parse import urlsplit

from prim.errors import OutputError, PrimError, UsageError

CONNECT_SECONDS = 3.0
"""A viewer must answer within this time (s); set by hand."""

PORTS_TRIED = 100


class ViewerUnreachableError(PrimError):
    """No viewer answers where one should."""


def check_display() -> None:
    """Raise UsageError where there is no display that a viewer could be opened on."""
    if os.name == "posix" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise UsageError("--spawn needs a display, and there is none: save with --save OUT.rrd, or --serve")


def check_viewer(url: str) -> None:
    """Check that something listens at ``url``.

    Raises:
        UsageError: The URL is not one of a viewer.
        ViewerUnreachableError: Nothing answers there.
    """
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError:
        parts, host, port = urlsplit(""), None, None
    if not parts.scheme.startswith("rerun") or host is None or port is None:
        raise UsageError(f"--connect {url}: give an address such as rerun+http://127.0.0.1:9876/proxy")
    try:
        socket.create_connection((host, port), timeout=CONNECT_SECONDS).close()
    except OSError as error:
        raise ViewerUnreachableError(f"no viewer answers at {url}: {error}; start one there with: rerun") from error


def local_address(host: str) -> str:
    """Return the IP address of a host of this machine, IPv4 where it has one. Raises UsageError for other hosts."""
    try:
        found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
        family, *_, place = min(found, key=lambda entry: entry[0] != socket.AF_INET)
        with socket.socket(family) as probe:
            probe.bind(place)
    except (OSError, ValueError) as error:
        raise UsageError(
            f"--serve-host {host}: not an address of this machine ({error}); 0.0.0.0 is every address"
        ) from error
    return str(place[0])


def find_free_port(first: int, address: str) -> int:
    """Find a port that nothing listens on.

    Args:
        first: Where to begin.
        address: The IP address.

    Returns:
        The first free port from there on.

    Raises:
        UsageError: There is none.
    """
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    for port in range(first, first + PORTS_TRIED):
        with socket.socket(family) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((address, port))
            except OSError:
                continue
            return port
    raise UsageError(f"--serve finds no free port from {first} to {first + PORTS_TRIED - 1}")


def partial_path(path: Path) -> Path:
    """Return where a recording lies until it is complete."""
    return path.with_name(path.name + ".part")


def create_partial(path: Path) -> Path:
    """Create an empty recording beside ``path`` and return its path. Raises OutputError where that fails."""
    try:
        partial_path(path).open("wb").close()
    except OSError as error:
        raise OutputError(path, error) from error
    return partial_path(path)
