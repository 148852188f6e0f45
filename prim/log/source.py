"""A log as the rest of prim sees it, whatever its format."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol, Self, TypeVar

Decoded = TypeVar("Decoded")


class Topic(NamedTuple):
    """One topic of a log.

    Attributes:
        name: Its name.
        type: The type of its messages, by its ROS 2 name (package/msg/Type).
        encoding: How they are serialized: «cdr» for ROS 2.
        messages: The number of messages.
    """

    name: str
    type: str
    encoding: str
    messages: int


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


class LogSource(Protocol):
    """A log that is open for reading, in bounded memory; a context manager that closes it.

    A log may be opened to recover what is left of a damaged one: losses are then collected in :attr:`lost`, while
    else every damage raises LogReadError.
    """

    @property
    def path(self) -> Path:
        """The log's file."""
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

    def __enter__(self) -> Self: ...

    def __exit__(self, *exception: object) -> None: ...

    def attachment(self, name: str) -> bytes | None:
        """Return the attachment of this name, None where there is none. Raises LogReadError."""
        ...

    def of_type(self, *types: str) -> list[Topic]:
        """Return the topics that have messages and are of any of these types, sorted by name."""
        ...

    def messages(self, *topics: str) -> Iterator[Message]:
        """Yield the messages of these topics by log time. Raises LogReadError where any is missing or damaged."""
        ...

    def decoded(self, topic: Topic, decode: Callable[[bytes], Decoded]) -> Iterator[tuple[int, Decoded]]:
        """Yield the decoded messages of one topic by log time.

        Args:
            topic: The topic.
            decode: Decodes a serialized message; raises ValueError on bytes that are not one.

        Yields:
            Log time (ns) and decoded message.

        Raises:
            LogReadError: A message is missing, damaged, or cannot be decoded.
        """
        ...

    def numbered(
        self, topic: Topic, decode: Callable[[bytes], Decoded], wanted: Container[int] | None = None
    ) -> Iterator[tuple[int, int, Decoded]]:
        """Yield decoded messages as :meth:`decoded`, with their indices.

        Args:
            topic: The topic.
            decode: As in :meth:`decoded`.
            wanted: The indices to decode and yield; None: all. The whole topic is read even so: only its end shows
                whether messages are missing.

        Yields:
            The message's index on its topic, its log time (ns), and the decoded message.

        Raises:
            LogReadError: As in :meth:`decoded`.
        """
        ...
