"""Checks before a recording is sent: rerun itself would wait, lose everything, and report nothing."""

from __future__ import annotations

import os
import socket
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
    except OSError as error:
        raise ViewerUnreachableError(f"no viewer answers at {url}: {error}; start one there with: rerun") from error


def find_free_port(first: int) -> int:
    """Return the first port from ``first`` on that nothing listens on. Raises UsageError where there is none."""
    for port in range(first, first + PORTS_TRIED):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(("", port))
            except OSError:
                continue
            return port
    raise UsageError(f"--serve finds no free port from {first} to {first + PORTS_TRIED - 1}")
