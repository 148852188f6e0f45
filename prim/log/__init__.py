"""Logs: reading them, recovering damaged ones, writing them; the messages in them and how those are serialized."""

from __future__ import annotations

import stat
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from prim.errors import LogReadError

if TYPE_CHECKING:
    from prim.log.source import LogSource

__all__ = ["open_log"]


def open_log(path: str | Path, recover: bool = False) -> LogSource:
    """Open a log for reading; its format is found by its first bytes.

    Args:
        path: An MCAP file, or a folder with one in it (a ROS 2 bag).
        recover: Read what is left of a damaged log.

    Returns:
        The log, to be used as a context manager.

    Raises:
        LogReadError: The file cannot be read, is damaged (unless ``recover``), or is no log of a known format.
    """
    file = _log_file(Path(path))
    start = _first_bytes(file)
    for magic, open_source in _SOURCES.items():
        if start.startswith(magic):
            return open_source(file, recover)
    if not start:
        raise LogReadError(file, "an empty file (0 bytes)", "give an .mcap log")
    for magic, (what, hint) in _UNSUPPORTED.items():
        if start.startswith(magic):
            raise LogReadError(file, f"{what}, not an MCAP log", hint)
    raise LogReadError(file, "not an MCAP log: it begins with other bytes", "give an .mcap log")


def _open_mcap(path: Path, recover: bool) -> LogSource:
    from prim.log.mcap import McapReader  # when it is needed: writing a log does without it

    return McapReader(path, recover)


_SOURCES: dict[bytes, Callable[[Path, bool], LogSource]] = {b"\x89MCAP0\r\n": _open_mcap}
"""How a log is opened, by the first bytes of its file."""

_UNSUPPORTED = {
    b"#ROSBAG": ("a ROS 1 bag", "convert it with: rosbags-convert --dst-storage mcap"),
    b"SQLite format 3": ("a ROS 2 bag in SQLite", "convert it with: rosbags-convert --dst-storage mcap"),
    b"\x89PNG": ("a PNG image", "give an .mcap log"),
    b"RRF2": ("a rerun recording", "open it with: rerun FILE"),
}
"""First bytes of files that cannot be read, what they are, and what to do."""


def _first_bytes(path: Path) -> bytes:
    """Return as many bytes of a file's start as tell its format. Raises LogReadError."""
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise LogReadError(path, "a pipe or a device, which cannot be read back and forth", "save it to a file")
        with path.open("rb") as stream:
            return stream.read(max(map(len, (*_SOURCES, *_UNSUPPORTED))))
    except OSError as error:
        raise LogReadError(path, f"cannot open: {error.strerror}") from error


def _log_file(path: Path) -> Path:
    """Return the log's file: ``path`` itself, or the one .mcap file in the folder ``path`` (a ROS 2 bag)."""
    if not path.is_dir():
        return path
    logs = sorted(path.glob("*.mcap"))
    if len(logs) == 1:
        return logs[0]
    if logs:
        names = ", ".join(log.name for log in logs)
        raise LogReadError(path, f"a folder with {len(logs)} logs ({names})", "give one of them")
    raise LogReadError(path, "a folder without an .mcap log in it", "give an .mcap file or a ROS 2 bag's folder")
