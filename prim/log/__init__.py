"""Logs: reading them, recovering damaged ones, writing them; the messages in them and how those are serialized."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from prim.log.source import LogSource

__all__ = ["open_log"]


def open_log(path: Path, recover: bool = False) -> LogSource:
    """Open a log for reading; its format is found by its first bytes.

    Args:
        path: An MCAP file, or a folder with one in it (a ROS 2 bag).
        recover: Read what is left of a damaged log.

    Returns:
        The log, to be used as a context manager.

    Raises:
        LogReadError: The file cannot be read, is damaged (unless ``recover``), or is no log of a known format.
    """
    from prim.log.mcap import McapReader  # when it is needed: writing a log does without it

    return McapReader(path, recover)
