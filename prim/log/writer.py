"""Writing MCAP logs."""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

from prim.files import OutputFile, ResultFormat, output_errors
from prim.interrupts import interrupted_run
from prim.log.messages import message_definition

if TYPE_CHECKING:
    from mcap.records import Channel, Schema

LIBRARY = "prim"
"""What the header of a recorded log names as its writer."""

RECORDED_LOG = ResultFormat(
    "a log of prim-record", re.compile(rb"\x89MCAP0\r\n\x01.{8}\x04\0\0\0ros2\x04\0\0\0prim", re.DOTALL)
)

CHUNK_BYTES, CHUNK_MESSAGES = 64 * 1024, 150
"""A chunk ends when it holds this much; the recorder fills one in a fraction of a second."""


class LogWriter:
    """Writes a ROS 2 MCAP log: chunked, zstd, with CRCs.

    Until it is closed, the log is a :class:`prim.files.OutputFile` in the making. Every chunk is handed to the
    operating system when it ends, and chunks are small and describe the topics in them, so that a recorder that is
    killed loses the last fraction of a second and the rest can be read with ``--recover``, whatever else is damaged.
    Where a chunk ends depends on the messages and not on the time, so that the same messages make the same bytes.

    Args:
        path: The log.
        force: Whether a file in its place may be replaced that is no earlier recording.

    Attributes:
        path: The log.
        part: Where it lies until it is closed.

    Raises:
        OutputError: The log cannot be written.
        UsageError: There is another file in its place.
        InterruptedRunError: A KeyboardInterrupt ended the ``with`` block; what was recorded until then is in
            :attr:`part`.
    """

    def __init__(self, path: Path, force: bool = False) -> None:
        self.path = path
        self._output = OutputFile(path, RECORDED_LOG, force)
        self.part = self._output.part
        with output_errors(path):
            self._file = self.part.open("wb")
        from mcap.writer import CompressionType, Writer  # when it is needed: a replay starts faster

        self._writer = Writer(self._file, chunk_size=1 << 40, compression=CompressionType.ZSTD, enable_crcs=True)
        self._writer.start(profile="ros2", library=LIBRARY)
        self._topics: dict[str, tuple[Schema, Channel]] = {}
        self._defined: set[str] = set()
        self._messages_in_chunk, self._bytes_in_chunk = 0, 0

    def __enter__(self) -> LogWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if error is not None and not isinstance(error, KeyboardInterrupt):
            self._discard()
            return
        try:
            with output_errors(self.path):
                self._writer.finish()  # type: ignore[no-untyped-call]
                self._file.close()
        except BaseException:
            self._discard()
            raise
        if isinstance(error, KeyboardInterrupt):
            raise interrupted_run(error, f"what was recorded until then is in {self.part}") from error
        self._output.commit()

    def _discard(self) -> None:
        """Remove what was written of the log."""
        with suppress(OSError):  # what is still buffered may have no place on the disk
            self._file.close()
        self._output.discard()

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add a metadata record; call it before the first message.

        Args:
            name: Its name.
            values: Its entries.
        """
        self._writer.add_metadata(name, dict(values))

    def add_attachment(self, name: str, media_type: str, data: bytes, stamp: int) -> None:
        """Add an attachment; call it before the first message.

        Args:
            name: Its name.
            media_type: Its MIME type.
            data: Its contents.
            stamp: When it was made (ns).
        """
        self._writer.add_attachment(stamp, stamp, name, media_type, data)

    def add_topic(self, topic: str, type_name: str, latched: bool = False) -> None:
        """Announce a topic.

        Args:
            topic: Its name.
            type_name: The type of its messages.
            latched: Whether its last message reaches late subscribers when the log is played back.
        """
        from mcap.records import Channel, Schema

        schema = Schema(0, message_definition(type_name).encode(), "ros2msg", type_name)
        schema.id = self._writer.register_schema(schema.name, schema.encoding, schema.data)
        channel = Channel(0, topic, "cdr", {"offered_qos_profiles": _LATCHED_QOS if latched else "[]"}, schema.id)
        channel.id = self._writer.register_channel(topic, channel.message_encoding, schema.id, channel.metadata)
        self._topics[topic] = schema, channel
        self._defined.add(topic)

    def write(self, topic: str, stamp: int, data: bytes) -> None:
        """Write one message.

        Args:
            topic: Its topic, which was announced.
            stamp: When it was logged and published (ns).
            data: The message in CDR.
        """
        with output_errors(self.path):
            if topic not in self._defined:
                self._repeat_definition(topic)
            self._writer.add_message(self._topics[topic][1].id, stamp, data, stamp)
            self._messages_in_chunk += 1
            self._bytes_in_chunk += len(data)
            if self._messages_in_chunk >= CHUNK_MESSAGES or self._bytes_in_chunk >= CHUNK_BYTES:
                self.flush()

    def _repeat_definition(self, topic: str) -> None:
        """Describe a topic once more, in the current chunk: it can be read where the first one is damaged."""
        builder = self._writer._Writer__chunk_builder  # type: ignore[attr-defined]  # nothing public repeats them
        schema, channel = self._topics[topic]
        builder.add_schema(schema)
        builder.add_channel(channel)
        self._defined.add(topic)

    def flush(self) -> None:
        """End the current chunk and hand everything to the operating system."""
        self._writer._Writer__finalize_chunk()  # type: ignore[attr-defined]  # nothing public ends a chunk
        self._file.flush()
        self._defined.clear()
        self._messages_in_chunk, self._bytes_in_chunk = 0, 0


_LATCHED_QOS = """\
- history: keep_last
  depth: 1
  reliability: reliable
  durability: transient_local
  deadline:
    sec: 9223372036
    nsec: 854775807
  lifespan:
    sec: 9223372036
    nsec: 854775807
  liveliness: automatic
  liveliness_lease_duration:
    sec: 9223372036
    nsec: 854775807
  avoid_ros_namespace_conventions: false
"""
