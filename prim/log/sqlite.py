"""A file of a ROS 2 bag in SQLite (.db3), of any version of its schema: all have the same columns of messages."""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from prim.arrays import Stamps
from prim.errors import LogReadError
from prim.log.decoding.codecs import SCAN_CONTENTS, content_of
from prim.log.log_file import LogFile
from prim.log.reader import LogReader
from prim.log.recovery import RECOVER_HINT
from prim.log.source import Message, Topic
from prim.log.time_resets import as_stamps, find_shifts, moved_behind_resets, reset_notes

PENDING = ("-wal", "-journal")
"""What SQLite appends to the name of a file for one with changes that are still to be made: of a killed recorder."""

MAX_STEP = 1 << 40
"""Behind damage, messages are searched for this far on (rows)."""

MAX_ROW = 1 << 62
"""Rows are numbered no higher, unless they are damaged."""


class SqliteBagReader(LogReader):
    """A file of a ROS 2 bag in SQLite that is open for reading: a :class:`prim.log.source.LogSource`.

    Args:
        file: The file.
        recover: Pass over what is damaged; messages are then read in the order in which they were written.

    Raises:
        LogReadError: The file cannot be read or is damaged (unless ``recover``).
    """

    _FORMAT = "ROS 2 bag (SQLite)"

    def __init__(self, file: LogFile, recover: bool = False) -> None:
        super().__init__(file.path, recover, file)
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._is_cut = False
        try:
            with _translated_errors(self.path, "" if recover else RECOVER_HINT):
                self._base = sqlite3.connect(self._address(file.data), uri=True, check_same_thread=False)
                if recover:
                    self._base.execute("PRAGMA writable_schema = ON")  # or a file that is cut cannot be opened
                self._numbers: dict[int, str] = {}
                self.topics = self._read_topics()
            self._shifts = self._find_shifts()
        except BaseException:
            self.close()
            raise
        self.notes = reset_notes(self._shifts)

    def _address(self, path: Path) -> str:
        """Return the address of the database; of a copy where changes are to be made to it first."""
        pending = [path.with_name(path.name + suffix) for suffix in PENDING]
        pending = [file for file in pending if file.is_file() and file.stat().st_size]
        if not pending:
            return f"{path.absolute().as_uri()}?immutable=1"
        self._folder = tempfile.TemporaryDirectory(prefix="prim-", ignore_cleanup_errors=True)
        copy = Path(self._folder.name) / "bag"
        shutil.copyfile(path, copy)
        for file in pending:
            shutil.copyfile(file, copy.with_name(copy.name + file.name.removeprefix(path.name)))
        return f"{copy.as_uri()}?mode=rw"

    def close(self) -> None:
        """Close the file."""
        if hasattr(self, "_base"):
            self._base.close()
        if self._folder:
            self._folder.cleanup()

    @property
    def messages_lost(self) -> int | None:
        """The number of messages that could not be read; None where the log does not say how many there were."""
        return None if self._is_cut else super().messages_lost

    def _read_topics(self) -> dict[str, Topic]:
        tables = {name for (name,) in self._base.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not {"topics", "messages"} <= tables:
            raise LogReadError(self.path, "a database of SQLite, but no ROS 2 bag: it lacks the tables of one")
        counts = self._counts()
        topics: dict[str, Topic] = {}
        for number, name, kind, encoding in self._base.execute(
            "SELECT id, name, type, serialization_format FROM topics ORDER BY id"
        ):
            self._numbers[number] = name
            count = counts[number] + (topics[name].messages if name in topics else 0)
            topics[name] = Topic(name, kind, encoding, count, content_of(kind))
        return topics

    def _counts(self) -> Counter[int]:
        """Return how many messages each topic has."""
        if self._recover:
            return Counter(topic for _, topic in self._rows("topic_id", ()))
        return Counter(dict(self._base.execute("SELECT topic_id, COUNT(*) FROM messages GROUP BY topic_id")))

    def _find_shifts(self) -> tuple[int, ...]:
        """Find out whether the log's times were set back."""
        scans = [number for number, name in self._numbers.items() if self.topics[name].content in SCAN_CONTENTS]
        if not scans:
            return (0,)
        columns, where = "timestamp", f"topic_id = {scans[0]}"
        if self._recover:
            times = [time for _, time in self._rows(columns, scans[:1])]
        else:
            with _translated_errors(self.path, RECOVER_HINT):
                query = f"SELECT {columns} FROM messages WHERE {where} ORDER BY rowid"
                times = [time for (time,) in self._base.execute(query)]
        return find_shifts(as_stamps(times))

    def log_times(self, topic: str) -> Stamps:
        """See :meth:`prim.log.reader.LogReader.log_times`: without reading the messages."""
        if self._recover or len(self._shifts) > 1:
            return super().log_times(topic)
        numbers = [number for number, name in self._numbers.items() if name == topic]
        query = (
            f"SELECT timestamp FROM messages WHERE topic_id IN ({', '.join('?' * len(numbers))}) ORDER BY timestamp"
        )
        with _translated_errors(self.path, RECOVER_HINT):
            return as_stamps(time for (time,) in self._base.execute(query, numbers))

    def messages(self, *topics: str) -> Iterator[Message]:
        """See :meth:`prim.log.source.LogSource.messages`; a log that is recovered is read in the order of writing."""
        found = self._stored_messages([number for number, name in self._numbers.items() if name in topics])
        return moved_behind_resets(found, self._shifts) if len(self._shifts) > 1 else found

    def _stored_messages(self, numbers: Sequence[int]) -> Iterator[Message]:
        """Yield the messages of these topics: by their times, or as they were written where that is more."""
        if self._recover:
            for _, number, time, data in self._rows("topic_id, timestamp, data", numbers):
                yield Message(self._numbers[number], time, data or b"")
            return
        order = "rowid" if len(self._shifts) > 1 else "timestamp, rowid"
        marks = ", ".join("?" * len(numbers))
        query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks}) ORDER BY {order}"
        with _translated_errors(self.path, RECOVER_HINT):
            for number, time, data in self._base.execute(query, numbers):
                yield Message(self._numbers[number], time, data or b"")

    def _rows(self, columns: str, numbers: Sequence[int]) -> Iterator[tuple[Any, ...]]:
        """Yield rowid and columns of the messages of these topics (none: of all) as written, past what is damaged."""
        query = f"SELECT topic_id, rowid, {columns} FROM messages WHERE rowid > ? ORDER BY rowid LIMIT ?"
        at, step, limit = -1, 0, -1
        while step < MAX_STEP and at < MAX_ROW:
            try:
                for number, *row in self._base.execute(query, (at, limit)):
                    if row[0] <= at:
                        raise sqlite3.DatabaseError("its pages do not fit together")
                    at, step = row[0], 0
                    if not numbers or number in numbers:
                        yield tuple(row)
                if limit < 0:
                    return
                limit = -1  # the last row before the damage was read by itself
            except sqlite3.DatabaseError as error:
                self._is_cut = True
                self._lose(f"messages in damaged pages of the database: {error}")
                at, step, limit = at + step, 2 * step + 1, 1


@contextmanager
def _translated_errors(path: Path, hint: str) -> Iterator[None]:
    """Turn what SQLite raises into a LogReadError that names ``path``."""
    try:
        yield
    except sqlite3.DatabaseError as error:
        raise LogReadError(path, f"damaged, or no ROS 2 bag: {error}", hint) from error
    except (OSError, UnicodeDecodeError) as error:
        raise LogReadError(path, f"cannot be read: {getattr(error, 'strerror', None) or error}") from error
