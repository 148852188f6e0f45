"""What all readers of logs have in common: messages by topic, decoded."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Container, Iterator, Mapping
from pathlib import Path
from typing import ClassVar, Self

import zstandard

from prim.arrays import Stamps
from prim.errors import LogReadError
from prim.log.decoding.codecs import Codec, Content, codec_of
from prim.log.limits import memory_limit, unpacked_limit
from prim.log.log_file import ZSTD_MAGIC, LogFile
from prim.log.source import Message, Numbered, Topic
from prim.log.time_resets import LATEST, as_stamps

RECOVER_HINT = "read what is left of it with --recover"

MAX_LOST = 100
"""So many losses are listed one by one."""

MAX_REASON = 300
"""Of the reason why a message cannot be decoded, so many characters are shown."""

MIN_WINDOW = 1 << 23
"""All frames of zstd that refer back no farther (bytes) are read (RFC 8878, 3.1.1.1.2, recommends that)."""


class LogReader(ABC):
    """A log that is open for reading: the part of :class:`prim.log.source.LogSource` that all formats share.

    Args:
        path: The log as the user names it.
        recover: Pass over damage, and collect it in :attr:`lost`.
        file: Its file, which is closed with the log; None where it has several.
    """

    _FORMAT: ClassVar[str]

    def __init__(self, path: Path, recover: bool, file: LogFile | None = None) -> None:
        self.path = path
        self._file_of_log = file
        self.lost: list[str] = [*file.lost] if file else []
        self.notes: list[str] = []
        self.topics: Mapping[str, Topic] = {}
        self.metadata: Mapping[str, Mapping[str, str]] = {}
        self._recover = recover
        self._undecodable: set[tuple[str, int]] = set()
        self._undecodable_topics: set[str] = set()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()
        if self._file_of_log:
            self._file_of_log.close()

    @abstractmethod
    def close(self) -> None:
        """Close the log's files."""

    @property
    def format(self) -> str:
        """The log's format, for people."""
        packed = self._file_of_log.compression if self._file_of_log else ""
        return f"{self._FORMAT} ({packed})" if packed else self._FORMAT

    @property
    def file_bytes(self) -> int:
        """The size of its files as the user names them, which what reading may take depends on."""
        return self._file_of_log.file_bytes if self._file_of_log else 0

    @abstractmethod
    def messages(self, *topics: str) -> Iterator[Message]:
        """See :meth:`prim.log.source.LogSource.messages`."""

    def log_times(self, topic: str) -> Stamps:
        """Return when the messages of a topic were logged (N,) in ns. Raises LogReadError."""
        return as_stamps(message.log_time for message in self.messages(topic))

    @property
    def messages_lost(self) -> int | None:
        """The number of messages that could not be read; None where the log does not say how many there were."""
        return len(self._undecodable)

    def attachment(self, name: str) -> bytes | None:
        """Return the attachment of this name: most formats have none. Raises LogReadError."""
        return None

    def holding(self, *contents: Content) -> list[Topic]:
        """See :meth:`prim.log.source.LogSource.holding`."""
        fitting = (topic for topic in self.topics.values() if topic.content in contents and topic.messages)
        return sorted(fitting, key=lambda topic: topic.name)

    def decoded(self, topic: Topic) -> Iterator[tuple[int, object]]:
        """See :meth:`prim.log.source.LogSource.decoded`."""
        for _, _, log_time, value in self._decoded_by({topic.name: self._codec(topic).decode}, None):
            yield log_time, value

    def numbered(self, *topics: Topic, wanted: Container[int] | None = None) -> Iterator[Numbered]:
        """See :meth:`prim.log.source.LogSource.numbered`."""
        return map(Numbered._make, self._decoded_by({t.name: self._codec(t).decode for t in topics}, wanted))

    def stamps(self, *topics: Topic) -> Iterator[Numbered]:
        """See :meth:`prim.log.source.LogSource.stamps`."""
        return map(Numbered._make, self._decoded_by({t.name: self._codec(t).stamp for t in topics}, None))

    def _codec(self, topic: Topic) -> Codec:
        """Return how a topic's messages are decoded. Raises LogReadError."""
        codec = codec_of(topic.type, topic.encoding)
        if codec is None:
            what = f"{topic.name} ({topic.type}) is encoded as {topic.encoding!r}, which cannot be read"
            raise LogReadError(self.path, what)
        return codec

    def _decoded_by(
        self, decoders: Mapping[str, Callable[[bytes], object]], wanted: Container[int] | None
    ) -> Iterator[tuple[int, str, int, object]]:
        """Yield numbers, topics, log times and decoded messages; plain tuples, since scans are most of a log."""
        decompressor = _Decompressor(self.file_bytes)
        for number, (name, log_time, data) in enumerate(self.messages(*decoders)):
            if wanted is not None and number not in wanted:
                continue
            if log_time >= LATEST:
                self._reject(name, number, ValueError(f"it was logged at {log_time / 1e9:g} s, beyond all times"))
                continue
            decode = decoders[name]
            try:
                value = decode(data)
            except ValueError as error:
                if not data.startswith(ZSTD_MAGIC):
                    self._reject(name, number, error)
                    continue
                try:
                    value = decode(decompressor.decompressed(data))
                except ValueError as final:
                    self._reject(name, number, final)
                    continue
            yield number, name, log_time, value

    def _lose(self, what: str) -> None:
        """Add a line to :attr:`lost`, once; of very many, the first."""
        if len(self.lost) < MAX_LOST and what not in self.lost:
            self.lost.append(what)
            if len(self.lost) == MAX_LOST:
                self.lost.append("and more")

    def _reject(self, topic: str, number: int, error: ValueError) -> None:
        """Count a message that cannot be decoded as lost; unless recovering, raise LogReadError."""
        reason = str(error)[:MAX_REASON]
        if not self._recover:
            what = f"message {number} of {topic} cannot be decoded: {reason}"
            raise LogReadError(self.path, what, "pass over such messages with --recover")
        if topic not in self._undecodable_topics:
            self._undecodable_topics.add(topic)
            self._lose(f"messages of {topic} that cannot be decoded, the first one {number}: {reason}")
        self._undecodable.add((topic, number))


class _Decompressor:
    """Decompresses messages that are each compressed, within the limits of the file that they are in.

    Args:
        file_bytes: Its size.
    """

    def __init__(self, file_bytes: int) -> None:
        self._largest = memory_limit(file_bytes)
        self._left = unpacked_limit(file_bytes)

    def decompressed(self, data: bytes) -> bytes:
        """Decompress a message that could not be decoded as it is. Raises ValueError."""
        largest = min(self._largest, self._left)
        try:
            claimed = zstandard.frame_content_size(data)
            if claimed > largest:
                raise ValueError(f"it is compressed, and claims {claimed} bytes, more than {largest}")
            unpacker = zstandard.ZstdDecompressor(max_window_size=max(largest, MIN_WINDOW))
            with unpacker.stream_reader(data) as stream:
                message = stream.read(largest if claimed < 0 else claimed)
                if stream.read(1):
                    raise ValueError(f"it is compressed, and larger than {len(message)} bytes")
        except zstandard.ZstdError as damage:
            raise ValueError(f"it is compressed, and damaged: {damage}") from damage
        self._left -= len(message)
        return message


def ros2_name(name: str) -> str:
    """Return the name of a message type in ROS 2: of ROS 1's package/Type, package/msg/Type; of others their own."""
    parts = name.split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else name
