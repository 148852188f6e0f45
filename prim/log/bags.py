"""The bags of ROS 1 (.bag) and of ROS 2 in SQLite (.db3), as rosbags reads them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, ClassVar

from prim.errors import LogReadError
from prim.log.decoding.codecs import content_of
from prim.log.log_file import LogFile
from prim.log.reader import LogReader
from prim.log.recovery import RECOVER_HINT
from prim.log.source import Message, Topic

if TYPE_CHECKING:
    from pathlib import Path


class BagReader(LogReader):
    """A bag that is open for reading: a :class:`prim.log.source.LogSource`.

    Args:
        file: The file.
        recover: Pass over messages that cannot be decoded, and over the rest of the file from the first damage on.

    Raises:
        LogReadError: The file cannot be read, is damaged (unless ``recover``), or its index is.
    """

    _ENCODING: ClassVar[str]

    def __init__(self, file: LogFile, recover: bool = False) -> None:
        super().__init__(file.path, recover, file)
        self._is_cut = False
        with _translated_errors(file.path):
            self._bag = self._reader(file.data)
            self._bag.open()
        self.topics = self._read_topics()

    @staticmethod
    def _reader(path: Path) -> Any:
        raise NotImplementedError

    def close(self) -> None:
        """Close the file."""
        self._bag.close()

    @property
    def messages_lost(self) -> int | None:
        """The number of messages that could not be read; None where the log does not say how many there were."""
        return None if self._is_cut else super().messages_lost

    def _read_topics(self) -> dict[str, Topic]:
        topics: dict[str, Topic] = {}
        for connection in self._bag.connections:
            earlier = topics.get(connection.topic)
            count = connection.msgcount + (earlier.messages if earlier else 0)
            encoding = getattr(connection.ext, "serialization_format", self._ENCODING)
            name = connection.msgtype
            topics[connection.topic] = Topic(connection.topic, name, encoding, count, content_of(name))
        return topics

    def messages(self, *topics: str) -> Iterator[Message]:
        """See :meth:`prim.log.source.LogSource.messages`."""
        connections = [connection for connection in self._bag.connections if connection.topic in topics]
        if not connections:
            return
        try:
            with _translated_errors(self.path, RECOVER_HINT):
                for connection, log_time, data in self._bag.messages(connections):
                    yield Message(connection.topic, log_time, data)
        except LogReadError as error:
            if not self._recover:
                raise
            what = f"messages of {', '.join(topics)} behind damage: {error.what}"
            self._is_cut = True
            self.lost += [what] * (what not in self.lost)


class Ros1BagReader(BagReader):
    """A ROS 1 bag, of format 2.0."""

    _FORMAT = "ROS 1 bag"
    _ENCODING = "ros1"

    @staticmethod
    def _reader(path: Path) -> Any:
        from rosbags.rosbag1 import Reader

        return Reader(path)


class SqliteBagReader(BagReader):
    """A file of a ROS 2 bag in SQLite."""

    _FORMAT = "ROS 2 bag (SQLite)"
    _ENCODING = "cdr"

    @staticmethod
    def _reader(path: Path) -> Any:
        from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

        return Sqlite3Reader(path)


@contextmanager
def _translated_errors(path: Path, hint: str = "") -> Iterator[None]:
    """Turn everything that rosbags raises on damaged files into a LogReadError that names ``path``."""
    try:
        yield
    except (LogReadError, AttributeError, NameError, GeneratorExit):
        raise
    except OSError as error:
        raise LogReadError(path, f"cannot be read: {error.strerror or error}") from error
    except Exception as error:  # ReaderError, struct.error, apsw.Error, KeyError, ...: the file is damaged
        raise LogReadError(path, f"damaged: {error}", hint) from error
