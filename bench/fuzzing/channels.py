"""Channels and schemas as no recorder writes them: many, unnamed, with the same number, of unknown encodings."""

from __future__ import annotations

import random
from collections.abc import Callable

from mcap.records import Channel, Metadata, Schema

from bench.fuzzing.case import Case
from bench.fuzzing.mcap_file import Assembly, Chunked
from bench.fuzzing.messages import message_record
from bench.fuzzing.samples import Samples
from tests.encodings.content import LogContent

NAMES = (
    "", "/", "//", " ", "scan", "/scan ", "/SCAN", "/scan\x00", "\x1b[2J\x1b]0;title\x07", "\u202e/nacs",
    "\u2028/a\u2029b", "\x85", "/a\nb\rc\td", "é" * 2000, "/" + "x" * 70_000, "'; rm -rf /; '", "$(id)", "{0}{path}",
    "%s%n", "[red]/scan[/red]", "\ud7ff", "-h", "--force", "/e\u0301", "\ufeff/scan", "🤖",
)  # fmt: skip
"""Names of topics, types and encodings."""

ENCODINGS = ("", "cdr", "ros1", "json", "protobuf", "cbor", "CDR", "\x1b[31mcdr", "x" * 70_000)
TYPES = (
    "", "sensor_msgs/msg/LaserScan", "sensor_msgs/LaserScan", "foxglove.LaserScan", "foxglove.",
    "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage", "a/b", "a/b/c/d", "sensor_msgs/msg/PointCloud2",
    "\x1b[2J/msg/x", "x" * 70_000,
)  # fmt: skip

MANY = (10, 300, 5_000, 60_000)
"""Numbers of further topics."""
OPTIONS = ("--no-viewer", "--no-detect", "--mapper", "det")


def hostile_channels(rng: random.Random, samples: Samples) -> Case:
    """Make a log whose channels and schemas are odd.

    Args:
        rng: The source of randomness.
        samples: The intact logs.

    Returns:
        The case.
    """
    file = Assembly(Chunked(rng.choice((0, 4096, 1 << 30)), rng.choice(("", "zstd", "lz4")), rng.random() < 0.7))
    parts = (_many_topics, _odd_names, _same_number, _missing_schemas, _odd_encodings, _odd_metadata, _many_scanners)
    what = rng.choices(parts, (1, 4, 4, 3, 4, 2, 1))[0](rng, file, samples.content)
    return Case(what, {"log.mcap": file.finish(with_summary=rng.random() < 0.8)}, options=OPTIONS)


Part = Callable[[random.Random, Assembly, LogContent], str]


def _described(number: int, topic: str, kind: str, encoding: str = "cdr", schema: int | None = None) -> Channel:
    schema = number if schema is None else schema
    return Channel(id=number, topic=topic, message_encoding=encoding, metadata={}, schema_id=schema)


def _schema(number: int, kind: str, encoding: str = "ros2msg", data: bytes = b"") -> Schema:
    return Schema(id=number, data=data, encoding=encoding, name=kind)


def _add_content(file: Assembly, content: LogContent, first: int = 1, leave_out: tuple[str, ...] = ()) -> None:
    """Add all topics and messages of the session, its channels numbered from ``first`` on."""
    numbers = {topic: number for number, topic in enumerate(content.types, first)}
    for topic, number in numbers.items():
        file.add(_schema(number, content.types[topic]), _described(number, topic, content.types[topic]))
    for topic, log_time, data in content.messages:
        if topic not in leave_out:
            file.add(message_record(numbers[topic], log_time, data))


def _many_topics(rng: random.Random, file: Assembly, content: LogContent) -> str:
    count = rng.choice(MANY)
    kind = rng.choice(("std_msgs/msg/String", "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry"))
    file.add(_schema(1, kind))
    has_messages = rng.random() < 0.5
    for number in range(count):
        file.add(_described(number + 100, f"/topic_{number}{rng.choice(('', chr(27)))}", kind, schema=1))
    if rng.random() < 0.8:
        _add_content(file, content)
    if has_messages:
        first = content.messages[0].log_time
        for number in range(min(count, 2_000)):
            file.add(message_record(number + 100, first, b"\0\1\0\0" + rng.randbytes(20)))
    return f"{count} further topics of {kind}{', with messages' if has_messages else ''}"


def _many_scanners(rng: random.Random, file: Assembly, content: LogContent) -> str:
    """Let all topics of scans, odometry and transforms be there many times."""
    count = rng.choice((2, 20, 40))
    for k in range(count):
        _add_content(_Renamed(file, f"/robot_{k}"), content, first=1 + 100 * k)
    return f"the session {count} times, under other names"


class _Renamed(Assembly):
    """Adds channels to a file under other names."""

    def __init__(self, file: Assembly, prefix: str) -> None:
        self._file, self._prefix = file, prefix

    def add(self, *records: object) -> None:
        """Add records."""
        for record in records:
            if isinstance(record, Channel):
                record.topic = self._prefix + record.topic
            self._file.add(record)  # type: ignore[arg-type]


def _odd_names(rng: random.Random, file: Assembly, content: LogContent) -> str:
    """Rename topics and types."""
    topics = {topic: topic for topic in content.types}
    types = dict(content.types)
    for _ in range(rng.randrange(1, 4)):
        topic = rng.choice(list(topics))
        if rng.random() < 0.6:
            topics[topic] = rng.choice(NAMES)
        else:
            types[topic] = rng.choice(NAMES)
    numbers = {topic: number for number, topic in enumerate(topics, 1)}
    for topic, number in numbers.items():
        file.add(_schema(number, types[topic]), _described(number, topics[topic], types[topic]))
    for message in content.messages:
        file.add(message_record(numbers[message.topic], message.log_time, message.data))
    changed = [f"{old} is {new[:20]!r}" for old, new in topics.items() if old != new]
    changed += [f"type of {topic} is {new[:20]!r}" for topic, new in types.items() if content.types[topic] != new]
    return ", ".join(changed)


def _same_number(rng: random.Random, file: Assembly, content: LogContent) -> str:
    """Use a number of a channel or schema again for something else: before, after, or amid the messages."""
    number = rng.randrange(1, len(content.types) + 1)
    record: Channel | Schema
    if rng.random() < 0.5:
        record = _described(
            number, rng.choice((*content.types, "/other")), "", rng.choice(ENCODINGS), rng.randrange(9)
        )
    else:
        record = _schema(number, rng.choice((*content.types.values(), *TYPES)), data=rng.randbytes(10))
    when = rng.choice(("before", "amid", "after"))
    if when == "before":
        file.add(record)
    _add_content(file, content)
    if when == "amid":
        file.add(record)
        _add_content(file, content)
    if when == "after":
        file.add(record)
    return f"{type(record).__name__} {number} again {when} the messages: {str(record)[:100]}"


def _missing_schemas(rng: random.Random, file: Assembly, content: LogContent) -> str:
    schema = rng.choice((0, 99, 65535))
    numbers = {topic: number for number, topic in enumerate(content.types, 1)}
    chosen = set(rng.sample(list(numbers), rng.randrange(1, len(numbers))))
    for topic, number in numbers.items():
        if topic not in chosen:
            file.add(_schema(number, content.types[topic]))
        missing = schema if topic in chosen else number
        file.add(_described(number, topic, content.types[topic], schema=missing))
    lost = rng.choice((None, *numbers))  # a channel whose messages belong to no channel at all
    for topic, log_time, data in content.messages:
        file.add(message_record(60_000 if topic == lost else numbers[topic], log_time, data))
    return f"schema {schema} of {', '.join(sorted(chosen))} is missing" + (
        f", the channel of {lost}, too" if lost else ""
    )


def _odd_encodings(rng: random.Random, file: Assembly, content: LogContent) -> str:
    numbers = {topic: number for number, topic in enumerate(content.types, 1)}
    topic = rng.choice(list(numbers))
    encoding, schema_encoding, kind = rng.choice(ENCODINGS), rng.choice(ENCODINGS), rng.choice(TYPES)
    kind = content.types[topic] if rng.random() < 0.4 else kind
    for other, number in numbers.items():
        is_it = other == topic
        file.add(_schema(number, kind if is_it else content.types[other], schema_encoding if is_it else "ros2msg"))
        file.add(_described(number, other, "", encoding if is_it else "cdr"))
    for message in content.messages:
        file.add(message_record(numbers[message.topic], message.log_time, message.data))
    return f"{topic} is {kind[:30]!r} in {encoding[:20]!r}, its schema in {schema_encoding[:20]!r}"


def _odd_metadata(rng: random.Random, file: Assembly, content: LogContent) -> str:
    """Add metadata of channels, and metadata records with odd names and values."""
    count = rng.choice((1, 50, 5_000))
    names = NAMES if count < 100 else [name for name in NAMES if len(name) < 100]
    for number in range(count):
        name = rng.choice(("prim", "prim", *names, str(number)))
        file.add(
            Metadata(metadata={rng.choice(names): rng.choice(names) for _ in range(rng.randrange(5))}, name=name)
        )
    _add_content(file, content)
    return f"{count} odd metadata records"
