"""The file of a log; one that is compressed as a whole, by zstd or gzip, is unpacked into a temporary one."""

from __future__ import annotations

import gzip
import shutil
import stat
import tempfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import IO

import zstandard

from prim.errors import LogReadError

HEAD_BYTES = 1 << 16
"""So much of a file's start is read to tell its format."""

COPIED_BYTES = 1 << 20
"""So much is unpacked at once."""

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
"""How a frame of zstd begins: a file, or a message that was compressed by itself. No message in CDR begins so."""


def _open_zstd(path: Path) -> IO[bytes]:
    stream: IO[bytes] = zstandard.open(path, "rb")
    return stream


def _open_gzip(path: Path) -> IO[bytes]:
    return gzip.GzipFile(path, "rb")  # type: ignore[return-value]


COMPRESSIONS: dict[bytes, tuple[str, Callable[[Path], IO[bytes]]]] = {
    ZSTD_MAGIC: ("zstd", _open_zstd),
    b"\x1f\x8b": ("gzip", _open_gzip),
}
"""What a compression is called, and how its files are opened, by their first bytes."""


class LogFile:
    """A file of a log, unpacked where it is compressed.

    Args:
        path: The file.
        recover: Keep what could be unpacked of a damaged file.

    Attributes:
        path: The file as the user names it.
        data: The file to read: ``path`` itself, or a temporary one.
        compression: «zstd» or «gzip»; empty where it is not compressed.
        head: The first bytes of ``data``, as many as tell its format.
        lost: What could not be unpacked.

    Raises:
        LogReadError: The file cannot be read, is damaged (unless ``recover``), or cannot be unpacked here.
    """

    def __init__(self, path: Path, recover: bool = False) -> None:
        self.path = self.data = path
        self.compression = ""
        self.lost: list[str] = []
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self.head = _head(path, path)
        for magic, (name, open_packed) in COMPRESSIONS.items():
            if self.head.startswith(magic):
                self.compression = name
                self._unpack(open_packed, recover)
                self.head = _head(self.data, path)

    def close(self) -> None:
        """Remove the temporary file."""
        if self._folder:
            self._folder.cleanup()

    def _unpack(self, open_packed: Callable[[Path], IO[bytes]], recover: bool) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="prim-", ignore_cleanup_errors=True)
        self.data = Path(self._folder.name) / self.path.stem
        try:
            with open_packed(self.path) as packed, self.data.open("wb") as unpacked:
                shutil.copyfileobj(packed, unpacked, COPIED_BYTES)
        except (zstandard.ZstdError, zlib.error, EOFError, gzip.BadGzipFile) as error:
            what = f"damaged: its {self.compression} compression ends early or does not fit ({error})"
            if not recover:
                self.close()
                raise LogReadError(self.path, what, "read what is left of it with --recover") from error
            self.lost.append(what)
        except OSError as error:
            self.close()
            raise LogReadError(self.path, f"cannot be unpacked: {error.strerror or error}") from error
        except BaseException:
            self.close()
            raise


def _head(file: Path, path: Path) -> bytes:
    """Return the first bytes of ``file``; errors name ``path``. Raises LogReadError."""
    try:
        if not stat.S_ISREG(file.stat().st_mode):
            raise LogReadError(path, "a pipe or a device, which cannot be read back and forth", "save it to a file")
        with file.open("rb") as stream:
            return stream.read(HEAD_BYTES)
    except OSError as error:
        raise LogReadError(path, f"cannot open: {error.strerror}") from error
