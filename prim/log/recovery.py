"""Reading MCAP files record by record, and past damage: every fault of a file becomes a LogReadError or a loss."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, InvalidMagic, McapError, RecordLengthLimitExceeded
from mcap.records import Chunk, ChunkIndex, McapRecord
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk

from prim.errors import LogReadError

RECORD_LIMIT = 1 << 30
"""Records of readable logs are no larger (bytes); a length beyond it is damage."""

RECORD_PREFIX = 1 + 8
"""Every record begins with an opcode and its length (bytes)."""

RECOVER_HINT = "read what is left of it with --recover"


class RecordReader:
    """Reads all records of an MCAP file, those in chunks among them.

    Args:
        stream: The file.
        path: Its path, for errors.
        recover: Pass over damaged chunks, instead of raising LogReadError.
    """

    def __init__(self, stream: IO[bytes], path: Path, recover: bool) -> None:
        self._stream = stream
        self._path = path
        self._recover = recover

    def indexed(self, chunks: Sequence[ChunkIndex], lost: list[str]) -> Iterator[McapRecord]:
        """Yield the records of the chunks that an index names, in file order; a damaged chunk hides no other.

        Args:
            chunks: The index of the chunks.
            lost: Gets a line for each chunk that could not be read.

        Yields:
            The records.
        """
        for index in sorted(chunks, key=lambda index: index.chunk_start_offset):
            try:
                with translated_errors(self._path):
                    chunk = read_chunk(self._stream, index)
            except LogReadError as error:
                lost.append(f"a chunk at byte {index.chunk_start_offset}: {error.what}")
                continue
            yield from self._chunk_records(chunk, lost)

    def linear(self, lost: list[str]) -> Iterator[McapRecord]:
        """Yield all records in file order, without an index; what follows a damaged record length is lost.

        Args:
            lost: Gets a line for each chunk that could not be read, and for a rest that could not be.

        Yields:
            The records.
        """
        self._stream.seek(0)
        records = StreamReader(self._stream, emit_chunks=True, record_size_limit=RECORD_LIMIT).records
        while True:
            try:
                with translated_errors(self._path):
                    record = next(records, None)
            except LogReadError as error:
                if not self._recover:
                    raise
                lost.append(f"all beyond byte {self._stream.tell()}: {error.what}")
                return
            if record is None:
                return
            if isinstance(record, Chunk):
                yield from self._chunk_records(record, lost)
            else:
                yield record

    def _chunk_records(self, chunk: Chunk, lost: list[str]) -> list[McapRecord]:
        try:
            with translated_errors(self._path):
                return breakup_chunk(chunk, validate_crc=True)
        except LogReadError as error:
            if not self._recover:
                raise
            seconds = (chunk.message_end_time - chunk.message_start_time) / 1e9
            lost.append(f"a chunk of {seconds:.2f} s that ends at byte {self._stream.tell()}: {error.what}")
            return []


def read_chunk(stream: IO[bytes], index: ChunkIndex) -> Chunk:
    """Read the chunk that an index entry points to, still compressed.

    Args:
        stream: The file.
        index: The entry of the chunk index.

    Returns:
        The chunk.
    """
    stream.seek(index.chunk_start_offset + RECORD_PREFIX)
    chunk: Chunk = Chunk.read(ReadDataStream(stream))
    return chunk


@contextmanager
def translated_errors(path: Path) -> Iterator[None]:
    """Turn everything that mcap and its codecs raise on damaged files into a LogReadError that names ``path``."""
    try:
        yield
    except (LogReadError, AttributeError, NameError):  # the latter two would be our own mistakes
        raise
    except CRCValidationError as error:
        what = f"damaged: the CRC of a {type(error.record).__name__} does not fit"
        raise LogReadError(path, what, RECOVER_HINT) from error
    except (EndOfFile, RecordLengthLimitExceeded) as error:
        raise LogReadError(path, "truncated or damaged: a record runs past the end", RECOVER_HINT) from error
    except InvalidMagic as error:
        raise LogReadError(path, "damaged: it does not end as an MCAP log does", RECOVER_HINT) from error
    except McapError as error:
        raise LogReadError(path, f"cannot be read: {error}") from error
    except OSError as error:
        raise LogReadError(path, f"cannot be read: {error.strerror or error}", RECOVER_HINT) from error
    except Exception as error:  # struct.error, KeyError, ZstdError, UnicodeDecodeError, ...: the file is damaged
        what = f"damaged: its records do not fit together ({type(error).__name__}: {error})"
        raise LogReadError(path, what, RECOVER_HINT) from error
