"""A log as the rest of prim sees it, whatever its format."""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol, Self

from prim.log.decoding.codecs import Content


class Topic(NamedTuple):
    """One topic of a log.

    Attributes:
        name: Its name.
        type: The type of its messages: of ROS messages the name in ROS 2 (package/msg/Type).
        encoding: How they are serialized: «cdr» for ROS 2.
        messages: The number of messages.
        content: What they hold; None where that is of no use here.
    """

    name: str
    type: str
    encoding: str
    messages: int
    content: Content | None = None


class Message(NamedTuple):
    """One message as it is stored in a log.

    Attributes:
        topic: The name of its topic.
        log_time: When it was logged (ns).
        data: The serialized message.
    """

    topic: str
    log_time: int
    data: bytes


class Numbered(NamedTuple):
    """A decoded message.

    Attributes:
        number: Which message it is among those that are read.
        topic: The name of its topic.
        log_time: When it was logged (ns).
        value: The message as :class:`prim.log.decoding.codecs.Content` defines it for the topic's content.
    """

    number: int
    topic: str
    log_time: int
    value: Any


class LogSource(Protocol):
    """A log that is open for reading, in bounded memory; a context manager that closes it.

    A log may be opened to recover what is left of a damaged one: losses are then collected in :attr:`lost`, while
    else every damage raises LogReadError.
    """

    @property
    def path(self) -> Path:
        """The log's file or folder."""
        ...

    @property
    def format(self) -> str:
        """Its format, for people."""
        ...

    @property
    def topics(self) -> Mapping[str, Topic]:
        """The log's topics by name."""
        ...

    @property
    def metadata(self) -> Mapping[str, Mapping[str, str]]:
        """The log's metadata records by name."""
        ...

    @property
    def lost(self) -> Sequence[str]:
        """What could not be read so far, for people; empty for an intact log."""
        ...

    @property
    def messages_lost(self) -> int | None:
        """The number of messages that could not be read; None where the log does not say how many there were."""
        ...

    @property
    def notes(self) -> Sequence[str]:
        """What a user should know of how the log is read."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(self, *exception: object) -> None: ...

    def attachment(self, name: str) -> bytes | None:
        """Return the attachment of this name, None where there is none. Raises LogReadError."""
        ...

    def holding(self, *contents: Content) -> list[Topic]:
        """Return the topics that have messages and hold any of these, sorted by name."""
        ...

    def messages(self, *topics: str) -> Iterator[Message]:
        """Yield the messages of these topics by log time. Raises LogReadError where any is missing or damaged."""
        ...

    def decoded(self, topic: Topic) -> Iterator[tuple[int, Any]]:
        """Yield the decoded messages of one topic by log time.

        Args:
            topic: The topic.

        Yields:
            Log time (ns), and the message, as what :class:`prim.log.decoding.codecs.Content` says.

        Raises:
            LogReadError: A message is missing, damaged, or cannot be decoded.
        """
        ...

    def numbered(self, *topics: Topic, wanted: Container[int] | None = None) -> Iterator[Numbered]:
        """Yield the decoded messages of one or several topics by log time, with their indices.

        Args:
            *topics: The topics.
            wanted: The indices to decode and yield; None: all. The whole topics are read even so: only their end
                shows whether messages are missing.

        Yields:
            The messages; their indices count those of these topics together.

        Raises:
            LogReadError: As in :meth:`decoded`.
        """
        ...

    def stamps(self, *topics: Topic) -> Iterator[Numbered]:
        """Yield the stamps of messages, which is faster than decoding all of them.

        Args:
            *topics: As in :meth:`numbered`.

        Yields:
            As :meth:`numbered`; the values are the stamps of their headers (ns).

        Raises:
            LogReadError: As in :meth:`decoded`.
        """
        ...
