"""Compressed files: unpacked as often as they are compressed, cut ones as far as they go."""

import bz2
import gzip
import io
import lzma
import struct
import tarfile
from collections.abc import Callable
from pathlib import Path

import pytest
import zstandard

from prim.errors import LogReadError
from prim.log import open_log
from prim.log.log_file import MAX_LAYERS, LogFile

CONTENT = b"".join(b"ODOM %d 0 0 0 0 0 %d.0 host %d.0\n" % (k * k * k, k, k) for k in range(5_000))

Compress = Callable[[bytes], bytes]


def zst_of_a_stream(data: bytes) -> bytes:
    """Compress without the size of what is compressed, in small blocks."""
    compressor = zstandard.ZstdCompressor(write_content_size=False).compressobj()
    blocks = [data[k : k + 9999] for k in range(0, len(data), 9999)]
    flush = zstandard.COMPRESSOBJ_FLUSH_BLOCK
    return b"".join(compressor.compress(block) + compressor.flush(flush) for block in blocks) + compressor.flush()


def unpacked(path: Path, recover: bool = False) -> tuple[bytes, LogFile]:
    file = LogFile(path, recover)
    try:
        return file.data.read_bytes(), file
    finally:
        file.close()


@pytest.mark.parametrize(
    "compress",
    [
        gzip.compress,
        zstandard.compress,
        zst_of_a_stream,
        lambda data: gzip.compress(data[:999]) + gzip.compress(data[999:]) + bytes(100),
        lambda data: zstandard.compress(data[:999]) + zstandard.compress(data[999:]),
        lambda data: struct.pack("<II", 0x184D2A50, 4) + b"skip" + zstandard.compress(data),
        lambda data: gzip.compress(gzip.compress(data)),
        lambda data: zstandard.compress(gzip.compress(data)),
        lambda data: gzip.compress(zstandard.compress(gzip.compress(data))),
    ],
)
def test_what_is_compressed_is_unpacked(tmp_path: Path, compress: Compress) -> None:
    path = tmp_path / "log"
    path.write_bytes(packed := compress(CONTENT))
    data, file = unpacked(path)
    assert data == CONTENT and not file.lost
    assert not file.data.exists() and path.read_bytes() == packed


def test_the_layers_are_named(tmp_path: Path) -> None:
    path = tmp_path / "log"
    path.write_bytes(zstandard.compress(gzip.compress(CONTENT)))
    assert unpacked(path)[1].compression == "gzip in zstd"


@pytest.mark.parametrize("compress", [gzip.compress, zst_of_a_stream])
@pytest.mark.parametrize("damage", [lambda packed: packed[: len(packed) * 7 // 10], lambda packed: packed[:-1]])
def test_what_ends_early_is_said_and_recovered(tmp_path: Path, compress: Compress, damage: Compress) -> None:
    path = tmp_path / "log"
    path.write_bytes(damage(compress(CONTENT)))
    with pytest.raises(LogReadError, match="ends early"):
        LogFile(path)
    data, file = unpacked(path, recover=True)
    assert CONTENT.startswith(data) and len(data) > 0.6 * len(CONTENT)
    assert len(file.lost) == 1 and "ends early" in file.lost[0]


@pytest.mark.parametrize("recover", [False, True])
@pytest.mark.parametrize(
    "packed", [gzip.compress(b"", mtime=0), zstandard.compress(b""), gzip.compress(CONTENT, mtime=0)[:9]]
)
def test_nothing_inside_is_one_clear_line(tmp_path: Path, packed: bytes, recover: bool) -> None:
    path = tmp_path / "log"
    path.write_bytes(packed)
    with pytest.raises(LogReadError, match=r"empty: |ends early"):
        LogFile(path, recover)


def test_there_are_limits(tmp_path: Path) -> None:
    data = CONTENT
    for _ in range(MAX_LAYERS + 1):
        data = gzip.compress(data)
    path = tmp_path / "log"
    path.write_bytes(data)
    with pytest.raises(LogReadError, match="compressed more than 4 times"):
        LogFile(path)


def tar(data: bytes) -> bytes:
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w") as archive:
        archive.addfile(tarfile.TarInfo("log.mcap"), io.BytesIO(data))
    return stream.getvalue()


@pytest.mark.parametrize(
    ("pack", "what"),
    [
        (bz2.compress, "bzip2, not a log; unpack it with: bzip2 -dc"),
        (lzma.compress, "xz, not a log; unpack it with: xz -dc"),
        (tar, "a tar archive, not a log; unpack it with: tar -xf"),
        (lambda data: gzip.compress(tar(data)), "a tar archive, not a log"),
    ],
)
def test_other_packages_are_named_with_what_opens_them(tmp_path: Path, pack: Compress, what: str) -> None:
    path = tmp_path / "log"
    path.write_bytes(pack(CONTENT))
    with pytest.raises(LogReadError, match=what):
        open_log(path)
