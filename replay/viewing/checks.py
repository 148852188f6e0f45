"""Checks before a recording is sent: rerun itself would wait, lose everything, and report nothing."""

from __future__ import annotations

import os
import socket
from collections.abc import Sequence
from urllib.parse import urlsplit

from prim.errors import PrimError, UsageError

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
    except (OSError, ValueError) as error:  # ValueError: no host can have that name
        raise ViewerUnreachableError(f"no viewer answers at {url}: {error}; start one there with: rerun") from error


def local_address(host: str) -> str:
    """Return the IP address of a host of this machine, IPv4 where it has one. Raises UsageError for other hosts."""
    if not host:
        raise UsageError("--serve-host: give an address of this machine; 0.0.0.0 is every address")
    try:
        found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
        family, *_, place = min(found, key=lambda entry: entry[0] != socket.AF_INET)
        with socket.socket(family) as probe:
            probe.bind(place)
    except (OSError, ValueError) as error:
        cause = getattr(error, "strerror", None) or error
        raise UsageError(
            f"--serve-host {host}: not an address of this machine ({cause}); 0.0.0.0 is every address"
        ) from error
    return str(place[0])


def find_free_ports(first: Sequence[int], address: str) -> list[int]:
    """Find ports that nothing listens on.

    Args:
        first: The ports that are wanted.
        address: The IP address.

    Returns:
        These ports or, where one of them is taken, as many others at the same distance above them.

    Raises:
        UsageError: There are none.
    """
    for step in range(PORTS_TRIED):
        ports = [port + step for port in first]
        if all(_is_free(port, address) for port in ports):
            return ports
    names = " and ".join(map(str, first))
    raise UsageError(f"--serve finds no free ports on {address}, from {names} to {PORTS_TRIED - 1} above them")


def _is_free(port: int, address: str) -> bool:
    with socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((address, port))
        except OSError:
            return False
    return True
