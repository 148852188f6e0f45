"""The bags of ROS 1 (.bag): as rosbags reads them by their index, or record by record where that is damaged."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

from rosbags.rosbag1 import Reader

from prim.errors import LogReadError
from prim.log.bag_records import BagRecords
from prim.log.decoding.codecs import SCAN_CONTENTS, content_of
from prim.log.log_file import LogFile
from prim.log.reader import LogReader, ros2_name
from prim.log.recovery import RECOVER_HINT
from prim.log.source import Message, Topic
from prim.log.time_resets import MIN_RESET, as_stamps, find_shifts, moved_behind_resets, reset_notes

ENCODING = "ros1"


class Ros1BagReader(LogReader):
    """A ROS 1 bag, of format 2.0, that is open for reading: a :class:`prim.log.source.LogSource`.

    Args:
        file: The file.

    Raises:
        LogReadError: The file cannot be read, or is damaged, or its index is.
    """

    _FORMAT = "ROS 1 bag"

    def __init__(self, file: LogFile) -> None:
        super().__init__(file.path, False, file)
        self._records = BagRecords(file.data.open("rb"), self.path)
        self._bag = Reader(file.data)
        try:
            with _translated_errors(file.path):
                self._bag.open()
            self.topics = _topics_of(
                (connection.topic, connection.msgtype, connection.msgcount) for connection in self._bag.connections
            )
            self._shifts = self._find_shifts()
        except BaseException:
            self.close()
            raise
        self.notes = reset_notes(self._shifts)

    def close(self) -> None:
        """Close the file."""
        self._records.close()
        if self._bag.bio:
            self._bag.close()

    def _find_shifts(self) -> tuple[int, ...]:
        """Find out whether the log's times were set back: where those of chunks do, by the messages of a scanner."""
        chunks = sorted(self._bag.chunk_infos, key=lambda chunk: chunk.pos)
        scans = next((name for name, topic in self.topics.items() if topic.content in SCAN_CONTENTS), None)
        if scans is None or not any(b.start_time < a.end_time - MIN_RESET for a, b in pairwise(chunks)):
            return (0,)
        times = [message.log_time for message in self._written_messages() if message.topic == scans]
        return find_shifts(as_stamps(times))

    def _written_messages(self) -> Iterator[Message]:
        """Yield all messages in the order in which they were written."""
        for connection, log_time, data in self._records.messages(None):
            yield Message(connection.topic, log_time, data)

    def messages(self, *topics: str) -> Iterator[Message]:
        """See :meth:`prim.log.source.LogSource.messages`."""
        if len(self._shifts) > 1:
            written = (message for message in self._written_messages() if message.topic in topics)
            yield from moved_behind_resets(written, self._shifts)
            return
        connections = [connection for connection in self._bag.connections if connection.topic in topics]
        if connections:
            with _translated_errors(self.path):
                for connection, log_time, data in self._bag.messages(connections):
                    yield Message(connection.topic, log_time, data)


class RecoveredBagReader(LogReader):
    """What is left of a ROS 1 bag, with or without an index, in the order in which it was written.

    Args:
        file: The file.
    """

    _FORMAT = "ROS 1 bag"

    def __init__(self, file: LogFile) -> None:
        super().__init__(file.path, True, file)
        self._records = BagRecords(file.data.open("rb"), self.path)
        counts: Counter[tuple[str, str]] = Counter()
        times: dict[str, list[int]] = {}
        for (topic, kind), log_time, _ in self._records.messages(self.lost):
            counts[topic, kind] += 1
            if content_of(ros2_name(kind)) in SCAN_CONTENTS:
                times.setdefault(topic, []).append(log_time)
        self._unread = max(self._records.expected - counts.total(), 0)
        self.topics = _topics_of((topic, kind, count) for (topic, kind), count in counts.items())
        self._shifts = find_shifts(as_stamps(next(iter(times.values()), [])))
        self.notes = reset_notes(self._shifts)

    def close(self) -> None:
        """Close the file."""
        self._records.close()

    @property
    def messages_lost(self) -> int | None:
        """The number of messages that could not be read; None where the log does not say how many there were."""
        if self.lost and not self._records.expected:
            return None
        return self._unread + len(self._undecodable)

    def messages(self, *topics: str) -> Iterator[Message]:
        """See :meth:`prim.log.source.LogSource.messages`."""
        written = (
            Message(connection.topic, log_time, data)
            for connection, log_time, data in self._records.messages([])
            if connection.topic in topics
        )
        return moved_behind_resets(written, self._shifts)


def _topics_of(connections: Iterator[tuple[str, str, int]]) -> Mapping[str, Topic]:
    """Return the topics of connections: name, type and number of messages."""
    topics: dict[str, Topic] = {}
    for name, kind, count in connections:
        count += topics[name].messages if name in topics else 0
        kind = ros2_name(kind)
        topics[name] = Topic(name, kind, ENCODING, count, content_of(kind))
    return topics


@contextmanager
def _translated_errors(path: Path) -> Iterator[None]:
    """Turn everything that rosbags raises on damaged files into a LogReadError that names ``path``."""
    try:
        yield
    except (LogReadError, AttributeError, NameError, GeneratorExit):
        raise
    except OSError as error:
        if error.errno is None:  # of bz2
            raise LogReadError(path, f"damaged: {error}", RECOVER_HINT) from error
        raise LogReadError(path, f"cannot be read: {error.strerror}") from error
    except Exception as error:  # ReaderError, struct.error, KeyError, ...: the file is damaged
        raise LogReadError(path, f"damaged: {error}", RECOVER_HINT) from error
