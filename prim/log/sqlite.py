"""A file of a ROS 2 bag in SQLite (.db3), of any version of its schema: all have the same columns of messages.

Queries go by the rows of the tables, in their order: an index could leave messages out.
"""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from array import array
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prim.arrays import Stamps
from prim.errors import LogReadError
from prim.log.decoding.codecs import SCAN_CONTENTS, content_of
from prim.log.limits import ROW_LIMITS, memory_limit, records_limit, unpacked_limit
from prim.log.log_file import LogFile
from prim.log.reader import RECOVER_HINT, LogReader
from prim.log.source import Message, Topic
from prim.log.time_resets import as_stamps, find_shifts, moved_behind_resets, reset_notes

PENDING = ("-wal", "-journal")
"""What SQLite appends to the name of a file for one with changes that are still to be made: of a killed recorder."""

MAX_STEP = 1 << 40
"""Behind damage, messages are searched for this far on (rows)."""

MAX_ROW = 1 << 62
"""Rows are numbered no higher, unless they are damaged, and times (ns) are no later."""

CHECKED = (1 << 31) - 1
"""Sums that are compared are of numbers modulo this one: they fit into 64 bits."""

STEPS_BASE, STEPS_A_BYTE, STEPS_AT_ONCE = 20_000_000, 10, 100_000
"""A query takes no more steps of SQLite than the first and the second for each byte; the third: how often that is
checked. A row takes about 30 steps and at least 8 bytes, a step about 10 ns."""


class _Table:
    """Which rows hold messages, in their order: 20 bytes each."""

    def __init__(self) -> None:
        self._rows, self._topics, self._times = array("q"), array("q"), array("q")

    def add(self, row: int, topic: int, time: int) -> None:
        """Add a row: its number, its topic's, and its time (ns)."""
        self._rows.append(row)
        self._topics.append(topic)
        self._times.append(time)

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def rows(self) -> NDArray[np.int64]:
        """The numbers of the rows (N,)."""
        return np.array(self._rows, np.int64)

    @property
    def topics(self) -> NDArray[np.int64]:
        """The numbers of their topics (N,)."""
        return np.array(self._topics, np.int64)

    @property
    def times(self) -> Stamps:
        """Their times (N,) in ns."""
        return np.array(self._times, np.int64)


_DAMAGE = (sqlite3.DatabaseError, MemoryError)
"""What SQLite raises on damaged pages: also that there is not the memory which they claim."""


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
        self._unpack_hint = file.unpack_hint
        self._data_bytes = file.data.stat().st_size
        self._steps = 0
        self._numbers: dict[int, str] = {}
        try:
            with self._translated_errors("" if recover else RECOVER_HINT):
                self._base = sqlite3.connect(self._address(file.data), uri=True, check_same_thread=False)
                self._restrict()
                self._check_tables()
                topics = self._read_topics()
                self._check_sizes()
                self._table = self._read_rows()
                self._check_index()
            counts = Counter(self._table.topics.tolist())
            self.topics = self._counted(topics, counts)
            self._shifts = self._find_shifts()
        except BaseException:
            self.close()
            raise
        self.notes = reset_notes(self._shifts)

    def _address(self, path: Path) -> str:
        """Return the address of the database; of a copy where changes are to be made to it first."""
        pending = [path.with_name(path.name + suffix) for suffix in PENDING]
        pending = [file for file in pending if file.is_file() and file.stat().st_size]
        self._data_bytes += sum(file.stat().st_size for file in pending)
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

    def _restrict(self) -> None:
        """Let the database run no code of its own, change nothing, and take no more than its size allows."""
        self._base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, min(memory_limit(self.file_bytes), (1 << 30) - 1))
        self._base.execute("PRAGMA trusted_schema = OFF")
        self._base.execute("PRAGMA query_only = ON")
        self._base.set_progress_handler(self._count_steps, STEPS_AT_ONCE)
        if self._recover:
            self._base.execute("PRAGMA writable_schema = ON")  # or a file that is cut cannot be opened

    def _count_steps(self) -> bool:
        """Return whether a query is to be stopped, since it takes too many steps."""
        self._steps += STEPS_AT_ONCE
        return self._takes_too_long

    @property
    def _takes_too_long(self) -> bool:
        return self._steps > STEPS_BASE + STEPS_A_BYTE * self._data_bytes

    def _query(self, query: str, values: Sequence[Any] = ()) -> sqlite3.Cursor:
        self._steps = 0
        return self._base.execute(query, values)

    def _check_tables(self) -> None:
        """Raise LogReadError where the tables are no plain ones, of rows that are stored as they are."""
        query = "SELECT name FROM sqlite_master WHERE type = 'table' AND rootpage > 0"  # else it is a virtual one
        if not {"topics", "messages"} <= {name for (name,) in self._query(query)}:
            raise LogReadError(self.path, "a database of SQLite, but no ROS 2 bag: it lacks the tables of one")
        for table in ("topics", "messages"):
            if any(hidden for *_, hidden in self._query(f"PRAGMA table_xinfo({table})")):
                raise LogReadError(self.path, "a database of SQLite, but no ROS 2 bag: it has generated columns")

    def _read_topics(self) -> list[Topic]:
        """Read the topics, without their numbers of messages."""
        topics = []
        query = "SELECT id, name, type, serialization_format FROM topics NOT INDEXED ORDER BY rowid"
        for number, *texts in self._query(query):
            if not isinstance(number, int) or not all(isinstance(text, str) for text in texts):
                self._damage("a topic whose number or type is none")
            elif self._numbers.setdefault(number, texts[0]) != texts[0]:
                self._damage(f"topic {number} is listed twice")
            else:
                name, kind, encoding = texts
                topics.append((number, Topic(name, kind, encoding, 0, content_of(kind))))
            if len(topics) > records_limit(self.file_bytes, ROW_LIMITS):
                raise LogReadError(self.path, f"more than {len(topics)} topics")
        return [topic for _, topic in sorted(topics, key=lambda item: item[0])]

    def _check_sizes(self) -> None:
        """Raise LogReadError where rows claim more than the file has: several may share pages of a damaged one."""
        query = "SELECT SUM(CASE typeof(data) WHEN 'blob' THEN LENGTH(data) END) FROM messages NOT INDEXED"
        try:
            ((claimed,),) = self._query(query)
        except _DAMAGE:
            if not self._recover:
                raise
            return
        if (claimed or 0) > self._data_bytes:
            self._damage(f"its messages claim {claimed} bytes of {self._data_bytes}")

    def _read_rows(self) -> _Table:
        """Read which messages there are."""
        table = _Table()
        limit = records_limit(self.file_bytes, ROW_LIMITS)
        for row, number, time, kind in self._rows("topic_id, timestamp, typeof(data)"):
            if not isinstance(number, int) or number not in self._numbers:
                self._damage("messages of a topic that is not listed")
            elif not isinstance(time, int) or abs(time) > MAX_ROW or kind not in ("blob", "null"):
                self._damage("messages whose time is no number, or whose data are no bytes")
            else:
                table.add(row, number, time)
            if len(table) > limit:
                raise LogReadError(
                    self.path, f"more than {limit} messages in {self.file_bytes} bytes", self._unpack_hint
                )
        return table

    def _check_index(self) -> None:
        """Compare the messages with an index of their times, where there is one: rows may be lost without a trace."""
        for _, index, _, _, is_partial in self._query("PRAGMA index_list(messages)").fetchall():
            name = '"' + index.replace('"', '""') + '"'
            columns = [column for *_, column in self._query(f"PRAGMA index_info({name})")]
            if columns != ["timestamp"] or is_partial or self._is_cut:
                continue
            query = f"SELECT COUNT(*), SUM(timestamp % ?), SUM(rowid % ?) FROM messages INDEXED BY {name}"
            try:
                count, *found = self._query(query, (CHECKED, CHECKED)).fetchone()
            except _DAMAGE as error:
                self._damage(f"its index of times cannot be read: {error}")
                continue
            sums = [int(np.fmod(values, CHECKED).sum()) for values in (self._table.times, self._table.rows)]
            if count != len(self._table) or (count and found != sums):
                self._damage(f"its index has {count} messages, which are not the {len(self._table)} that are there")

    def _damage(self, what: str) -> None:
        """Note what is lost; unless recovering, raise LogReadError."""
        if not self._recover:
            raise LogReadError(self.path, f"damaged: {what}", RECOVER_HINT)
        self._is_cut = True
        self._lose(what)

    def _counted(self, topics: Sequence[Topic], counts: Counter[int]) -> dict[str, Topic]:
        """Return the topics by name, with their numbers of messages."""
        messages: Counter[str] = Counter()
        for number, name in self._numbers.items():
            messages[name] += counts[number]
        return {topic.name: topic._replace(messages=messages[topic.name]) for topic in topics}

    def _find_shifts(self) -> tuple[int, ...]:
        """Find out whether the log's times were set back."""
        scans = [number for number, name in self._numbers.items() if self.topics[name].content in SCAN_CONTENTS]
        if not scans:
            return (0,)
        return find_shifts(as_stamps(self._table.times[self._table.topics == scans[0]].tolist()))

    def _selected(self, topics: Sequence[str]) -> NDArray[np.int64]:
        """Return which messages (M,) are of these topics: by their times, or as written where that is more."""
        numbers = [number for number, name in self._numbers.items() if name in topics]
        selected = np.flatnonzero(np.isin(self._table.topics, np.array(numbers, np.int64)))
        if self._recover or len(self._shifts) > 1:
            return selected
        by_time: NDArray[np.int64] = selected[np.argsort(self._table.times[selected], kind="stable")]
        return by_time

    def log_times(self, topic: str) -> Stamps:
        """See :meth:`prim.log.reader.LogReader.log_times`: without reading the messages."""
        if self._recover or len(self._shifts) > 1:
            return super().log_times(topic)
        return as_stamps(self._table.times[self._selected((topic,))].tolist())

    def messages(self, *topics: str) -> Iterator[Message]:
        """See :meth:`prim.log.source.LogSource.messages`; a log that is recovered is read in the order of writing."""
        found = self._stored_messages(self._selected(topics))
        return moved_behind_resets(found, self._shifts) if len(self._shifts) > 1 else found

    def _stored_messages(self, selected: NDArray[np.int64]) -> Iterator[Message]:
        """Yield the messages of these rows, one by one."""
        left = unpacked_limit(self._data_bytes)
        rows, topics, times = self._table.rows, self._table.topics, self._table.times
        for k in selected.tolist():
            with self._translated_errors(RECOVER_HINT):
                try:
                    found = self._query("SELECT data FROM messages WHERE rowid = ?", (int(rows[k]),)).fetchone()
                except _DAMAGE as error:
                    if not self._recover:
                        raise
                    self._damage(f"messages in damaged pages of the database: {error}")
                    continue
            data = (found[0] if found else None) or b""
            left -= len(data)
            if left < 0:
                what = f"its messages claim more than the {self._data_bytes} bytes that there are"
                raise LogReadError(self.path, f"damaged: {what}")
            yield Message(self._numbers[int(topics[k])], int(times[k]), data)

    def _rows(self, columns: str) -> Iterator[tuple[Any, ...]]:
        """Yield rowid and columns of all messages as written, past what is damaged where that is to be recovered."""
        query = f"SELECT rowid, {columns} FROM messages NOT INDEXED WHERE rowid > ? ORDER BY rowid LIMIT ?"
        at, step, limit = -MAX_ROW, 0, -1
        while step < MAX_STEP and at < MAX_ROW:
            try:
                for row in self._query(query, (at, limit)):
                    if not isinstance(row[0], int) or row[0] <= at:
                        raise sqlite3.DatabaseError("its pages do not fit together")
                    at, step = row[0], 0
                    yield row
                if limit < 0:
                    return
                limit = -1  # the last row before the damage was read by itself
            except _DAMAGE as error:
                if self._takes_too_long:
                    raise
                self._damage(f"messages in damaged pages of the database: {error}")
                at, step, limit = max(at, -1) + step, 2 * step + 1, 1

    @contextmanager
    def _translated_errors(self, hint: str) -> Iterator[None]:
        """Turn what SQLite raises into a LogReadError."""
        try:
            yield
        except _DAMAGE as error:
            if self._takes_too_long:
                what = f"a query of its {self._data_bytes} bytes takes too many steps"
                raise LogReadError(self.path, f"damaged, or no ROS 2 bag: {what}") from error
            what = str(error) or "its pages claim more memory than there is"
            raise LogReadError(self.path, f"damaged, or no ROS 2 bag: {what}", hint) from error
        except (OSError, UnicodeDecodeError) as error:
            raise LogReadError(self.path, f"cannot be read: {getattr(error, 'strerror', None) or error}") from error
