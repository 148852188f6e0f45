"""Logs: reading them, recovering damaged ones, writing them; the messages in them and how those are serialized."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from prim.errors import LogReadError

if TYPE_CHECKING:
    from prim.log.log_file import LogFile
    from prim.log.reader import LogReader
    from prim.log.source import LogSource

__all__ = ["open_log"]


def open_log(path: str | Path, recover: bool = False) -> LogSource:
    """Open a log for reading; its format is found by its content, whatever its name.

    Args:
        path: An MCAP file, a ROS 2 bag's folder or .db3 file, a ROS 1 bag, or a log of CARMEN; compressed or not, by
            zstd or gzip.
        recover: Read what is left of a damaged log.

    Returns:
        The log, to be used as a context manager.

    Raises:
        LogReadError: The file cannot be read, is damaged (unless ``recover``), or is no log of a known format.
    """
    from prim.log.parts import METADATA, files_of_bag, notes_on_part, notes_on_unlisted

    path = Path(path)
    if path.name == METADATA:
        path = path.parent
    if not path.is_dir():
        log = _open_file(path, recover)
        log.notes += notes_on_part(path)
        return log
    try:
        files = files_of_bag(path)
        unlisted = notes_on_unlisted(path, files)
    except OSError as error:
        raise LogReadError(path, f"cannot open: {error.strerror}") from error
    log = _open_files(path, files, recover)
    log.notes += unlisted
    return log


def _open_files(path: Path, files: Sequence[Path], recover: bool) -> LogReader:
    from prim.log.parts import PartsReader

    if len(files) == 1 and files[0].exists():
        return _open_file(files[0], recover)
    return PartsReader(path, files, recover, lambda file: _open_file(file, recover))


def _open_file(path: Path, recover: bool) -> LogReader:
    """Open a file that is a log, or is one when it is unpacked."""
    from prim.log.log_file import LogFile

    file = LogFile(path, recover)
    try:
        return _opener(file, recover)(file, recover)
    except BaseException:
        file.close()
        raise


def _opener(file: LogFile, recover: bool) -> Callable[[LogFile, bool], LogReader]:
    """Return what opens a log of this content; to recover one whose start is damaged, its name counts.

    Raises LogReadError.
    """
    for magic, open_source in _SOURCES.items():
        if file.head.startswith(magic):
            return open_source
    for magic, (what, hint) in _UNSUPPORTED.items():
        if file.head.startswith(magic):
            raise LogReadError(file.path, f"{what}, not a log", hint.format(shlex.quote(str(file.path))))
    if file.head[TAR_AT:].startswith(TAR_MAGIC):
        raise LogReadError(
            file.path, "a tar archive, not a log", f"unpack it with: tar -xf {shlex.quote(str(file.path))}"
        )
    if not file.head:
        raise LogReadError(file.path, "an empty file (0 bytes)", _KNOWN)
    from prim.log import carmen

    if carmen.START.match(file.head):
        return carmen.CarmenReader
    if recover and ".mcap" in file.path.name:
        return _open_mcap
    raise LogReadError(file.path, "not a log of a known format: it begins with other bytes", _KNOWN)


def _open_mcap(file: LogFile, recover: bool) -> LogReader:
    from prim.log.mcap.reader import McapReader  # when it is needed: writing a log does without it

    return McapReader(file, recover)


def _open_bag(file: LogFile, recover: bool) -> LogReader:
    from prim.log.bags import BagReader

    return BagReader(file, recover)


def _open_sqlite(file: LogFile, recover: bool) -> LogReader:
    from prim.log.sqlite import SqliteBagReader

    return SqliteBagReader(file, recover)


_SOURCES: dict[bytes, Callable[[LogFile, bool], LogReader]] = {
    b"\x89MCAP0\r\n": _open_mcap,
    b"#ROSBAG V2": _open_bag,
    b"SQLite format 3\0": _open_sqlite,
}
"""How a log is opened, by the first bytes of its file."""

_UNSUPPORTED = {
    b"\x89PNG": ("a PNG image", "give a log"),
    b"RRF2": ("a rerun recording", "open it with: rerun {}"),
    b"#ROSBAG V1": ("a ROS 1 bag of the old format 1.2", "convert it with: rosbag fix {0} {0}.v2.bag"),
    b"PK\x03\x04": ("a ZIP archive", "unpack it with: unzip {}"),
    b"BZh": ("compressed by bzip2", "unpack it with: bzip2 -dc {0} > {0}.unpacked"),
    b"\xfd7zXZ\0": ("compressed by xz", "unpack it with: xz -dc {0} > {0}.unpacked"),
    b"\x04\x22\x4d\x18": ("compressed by lz4", "unpack it with: lz4 -dc {0} > {0}.unpacked"),
}
"""First bytes of files that cannot be read, what they are, and what to do."""

TAR_AT, TAR_MAGIC = 257, b"ustar"
"""The magic of a tar archive, and at which byte it is."""

_KNOWN = "give an MCAP log, a ROS 1 or ROS 2 bag, or a log of CARMEN"
