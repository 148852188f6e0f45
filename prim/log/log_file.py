"""The file of a log; one that is compressed as a whole, by zstd or gzip, is unpacked into a temporary one."""

from __future__ import annotations

import shlex
import stat
import tempfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

import zstandard

from prim.errors import LogReadError
from prim.log.limits import unpacked_limit

HEAD_BYTES = 1 << 16
"""So much of a file's start is read to find its format."""

PACKED_BYTES = 1 << 10
"""So much is unpacked at once: a block of zstd may become 2^15 times as large (32 MiB)."""

MAX_WINDOW = 1 << 27
"""A frame of zstd may refer back so far (bytes), which is kept in memory: the limit of the program zstd, too."""

MAX_LAYERS = 4
"""A file is compressed no more often."""

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
"""How a frame of zstd begins: a file, or a message that was compressed by itself. No message in CDR begins so."""

ZSTD_SKIPPABLE_MAGIC = b"\x50\x2a\x4d\x18"
"""How a frame of zstd begins that has no data, as pzstd puts them before the others (RFC 8878, 3.1.2)."""


class _EndsEarlyError(ValueError):
    """What a file's last frame lacks."""


class _WindowError(ValueError):
    """A frame that takes more memory than is allowed."""


def _unzstd(packed: IO[bytes]) -> Iterator[bytes]:
    """Yield what a file of one or several frames of zstd holds. Raises ZstdError, _EndsEarlyError, _WindowError."""
    unpacker = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW)
    frame, is_whole, is_first = unpacker.decompressobj(), False, True
    while piece := packed.read(PACKED_BYTES):
        if is_first and zstandard.get_frame_parameters(piece).window_size > MAX_WINDOW:
            raise _WindowError
        is_first = False
        while piece:
            if is_whole:
                frame, is_whole = unpacker.decompressobj(), False
            yield frame.decompress(piece)
            is_whole, piece = frame.eof, frame.unused_data if frame.eof else b""
    if not is_whole:
        raise _EndsEarlyError("the last frame is not whole")


def _gunzip(packed: IO[bytes]) -> Iterator[bytes]:
    """Yield what a file of one or several members of gzip holds, zeros behind them left out.

    Raises zlib.error, _EndsEarlyError.
    """
    member = zlib.decompressobj(wbits=16 + zlib.MAX_WBITS)
    while piece := packed.read(PACKED_BYTES):
        while piece:
            if member.eof:
                piece = piece.lstrip(b"\0")
                member = zlib.decompressobj(wbits=16 + zlib.MAX_WBITS) if piece else member
                continue
            yield member.decompress(piece)
            piece = member.unused_data
    if not member.eof:
        raise _EndsEarlyError("the last member is not whole")


COMPRESSIONS: dict[bytes, tuple[str, Callable[[IO[bytes]], Iterator[bytes]]]] = {
    ZSTD_MAGIC: ("zstd", _unzstd),
    ZSTD_SKIPPABLE_MAGIC: ("zstd", _unzstd),
    b"\x1f\x8b": ("gzip", _gunzip),
}
"""What a compression is called, and how its files are unpacked, by their first bytes."""


class LogFile:
    """A file of a log, unpacked where it is compressed.

    Args:
        path: The file.
        recover: Keep what could be unpacked of a damaged file.

    Attributes:
        path: The file as the user names it.
        data: The file to read: ``path`` itself, or a temporary one.
        file_bytes: The size of ``path``, which what reading may take depends on (:mod:`prim.log.limits`).
        compression: «zstd» or «gzip»; empty where it is not compressed.
        head: The first bytes of ``data``, as many as its format is found by.
        lost: What could not be unpacked.
        file_bytes: The size of ``path`` (bytes), which what may be unpacked is measured by.

    Raises:
        LogReadError: The file cannot be read, is damaged (unless ``recover``), cannot be unpacked here, or unpacks to
            more than :func:`prim.log.limits.unpacked_limit`.
    """

    def __init__(self, path: Path, recover: bool = False) -> None:
        self.path = self.data = path
        self.file_bytes = self._unpacked_bytes = 0
        self.compression = ""
        self.lost: list[str] = []
        self._layers: list[str] = []
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self.head = _head(path, path)
        self.file_bytes = path.stat().st_size
        try:
            self._unpack_all(recover)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Remove the temporary file."""
        if self._folder:
            self._folder.cleanup()

    @property
    def unpack_hint(self) -> str:
        """What to do where a log that is compressed exceeds a limit; empty where it is not compressed."""
        return f"if you trust it, {self._hint(self._layers)}" if self._layers else ""

    def _unpack_all(self, recover: bool) -> None:
        """Unpack the file as often as it is compressed. Raises LogReadError."""
        layers = self._layers
        while (compression := _compression(self.head)) is not None:
            if len(layers) == MAX_LAYERS:
                raise LogReadError(self.path, f"compressed more than {MAX_LAYERS} times", self._hint(layers[:1]))
            name, unpacked = compression
            layers.append(name)
            self._unpack(layers, unpacked, recover)
            self.head = _head(self.data, self.path)
        self.compression = " in ".join(reversed(layers))
        if layers and not self.head:
            raise LogReadError(self.path, self.lost[-1] if self.lost else f"empty: {layers[-1]} of no bytes")

    def _unpack(self, layers: list[str], unpacked: Callable[[IO[bytes]], Iterator[bytes]], recover: bool) -> None:
        """Unpack the last one of the layers that were found. Raises LogReadError."""
        if self._folder is None:
            self._folder = tempfile.TemporaryDirectory(prefix="prim-", ignore_cleanup_errors=True)
        packed, self.data = self.data, Path(self._folder.name) / str(len(layers))
        try:
            with packed.open("rb") as stream, self.data.open("wb") as out:
                for piece in unpacked(stream):
                    self._check_size(len(piece), layers)
                    out.write(piece)
        except _WindowError as error:
            what = f"its zstd compression takes more than {MAX_WINDOW} bytes of memory"
            raise LogReadError(self.path, what, self._hint(layers, " --long=31")) from error
        except (zstandard.ZstdError, zlib.error, _EndsEarlyError) as error:
            what = f"damaged: its {layers[-1]} compression ends early or does not fit ({error})"
            if not recover:
                raise LogReadError(self.path, what, "read what is left of it with --recover") from error
            self.lost.append(what)
        except OSError as error:
            raise LogReadError(self.path, f"cannot be unpacked: {error.strerror or error}") from error
        if len(layers) > 1:
            packed.unlink()

    def _check_size(self, more: int, layers: list[str]) -> None:
        """Count bytes that were unpacked; raise LogReadError where all layers together have too many."""
        self._unpacked_bytes += more
        limit = unpacked_limit(self.file_bytes)
        if self._unpacked_bytes > limit:
            what = f"its {self.file_bytes} bytes unpack to more than {limit} bytes"
            raise LogReadError(self.path, what, f"if you trust it, {self._hint(layers)}")

    def _hint(self, layers: list[str], options: str = "") -> str:
        """Return what to do where the file cannot be unpacked here."""
        quoted = shlex.quote(str(self.path))
        others = "".join(f" | {name} -dc{options if name == 'zstd' else ''}" for name in layers[1:])
        options = options if layers[0] == "zstd" else ""
        return f"unpack it with: {layers[0]} -dc{options} {quoted}{others} > {quoted}.unpacked"


def _compression(head: bytes) -> tuple[str, Callable[[IO[bytes]], Iterator[bytes]]] | None:
    """Return what a file that begins so is compressed by, and how it is unpacked; None where it is not."""
    return next((found for magic, found in COMPRESSIONS.items() if head.startswith(magic)), None)


def _head(file: Path, path: Path) -> bytes:
    """Return the first bytes of ``file``; errors name ``path``. Raises LogReadError."""
    try:
        if not stat.S_ISREG(file.stat().st_mode):
            raise LogReadError(path, "a pipe or a device, which cannot be read back and forth", "save it to a file")
        with file.open("rb") as stream:
            return stream.read(HEAD_BYTES)
    except OSError as error:
        raise LogReadError(path, f"cannot open: {error.strerror}") from error
