"""What a log holds, apart from how it is written: the writers of this folder take it, and so do the reductions."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from prim.log import open_log
from prim.log.decoding.codecs import codec_of
from prim.log.decoding.values import StampedPose
from prim.log.messages import (
    BASE_FRAME,
    LASER_FRAME,
    TF_STATIC_TOPIC,
    TF_TYPE,
    TRUE_POSE_TOPIC,
    TRUE_PRIMITIVES_TOPIC,
    encode_transforms,
)
from prim.log.source import Message
from prim.se2 import Pose2D

LATCHED = (TF_STATIC_TOPIC, TRUE_PRIMITIVES_TOPIC)
"""Topics that a late subscriber must get the last message of."""


@dataclass(frozen=True)
class LogContent:
    """The content of a log.

    Attributes:
        types: The ROS 2 type of each topic.
        messages: Topics, log times and CDR, in the order in which they are written.
        metadata: Metadata records by name.
        attachments: Attachments by name.
    """

    types: dict[str, str]
    messages: tuple[Message, ...]
    metadata: dict[str, dict[str, str]]
    attachments: dict[str, bytes]

    def of(self, topic: str) -> list[Message]:
        """Return the messages of one topic."""
        return [message for message in self.messages if message.topic == topic]


def read_content(path: Path) -> LogContent:
    """Read what prim-record wrote."""
    with open_log(path) as log:
        types = {topic.name: topic.type for topic in log.topics.values()}
        world = log.attachment("world.json")
        metadata = {name: dict(values) for name, values in log.metadata.items()}
        return LogContent(types, tuple(log.messages(*types)), metadata, {"world.json": world} if world else {})


def delayed(content: LogContent) -> LogContent:
    """Log each message 2 ms after its stamp and 1 us after the one before: no two at once, none at its stamp."""
    messages = (
        message._replace(log_time=message.log_time + 2_000_000 + 1_000 * k)
        for k, message in enumerate(content.messages)
    )
    return replace(content, messages=tuple(messages))


def without_truth(content: LogContent) -> LogContent:
    """Leave out all that says where the robot and the primitives really were."""
    return without_records(_without(content, TRUE_POSE_TOPIC, TRUE_PRIMITIVES_TOPIC))


def without_records(content: LogContent) -> LogContent:
    """Leave out metadata and attachments: what only MCAP has."""
    return replace(content, metadata={}, attachments={})


def by_topic(content: LogContent) -> LogContent:
    """Write one topic after the other, the last messages first."""
    return replace(content, messages=tuple(sorted(content.messages, key=lambda m: (m.topic, -m.log_time))))


def remounted(content: LogContent, mount: Pose2D) -> LogContent:
    """Say that the laser is mounted elsewhere on the robot; its scans stay what they are."""

    def moved(message: Message) -> Message:
        if message.topic != TF_STATIC_TOPIC:
            return message
        stamp = decode_poses(TF_TYPE, message.data)[0].stamp
        return message._replace(data=encode_transforms([(stamp, BASE_FRAME, LASER_FRAME, mount)]))

    return replace(content, messages=tuple(map(moved, content.messages)))


def mapped(content: LogContent, types: dict[str, str], convert: Callable[[Message], Iterable[bytes]]) -> LogContent:
    """Reduce a log to some topics, whose messages are converted.

    Args:
        content: The log.
        types: The topics that are left, and their types.
        convert: Returns the messages that one message becomes.

    Returns:
        The reduced log, without metadata and attachments.
    """
    messages = (m._replace(data=data) for m in content.messages if m.topic in types for data in convert(m))
    return LogContent(types, tuple(messages), {}, {})


def parts(content: LogContent, count: int) -> list[LogContent]:
    """Cut a log into consecutive parts, each with all topics, as a recorder does that begins a new file."""
    size = -(-len(content.messages) // count)
    return [replace(content, messages=content.messages[k * size : (k + 1) * size]) for k in range(count)]


def _without(content: LogContent, *topics: str) -> LogContent:
    types = {topic: kind for topic, kind in content.types.items() if topic not in topics}
    return replace(content, types=types, messages=tuple(m for m in content.messages if m.topic in types))


def decode_poses(type_name: str, data: bytes) -> list[StampedPose]:
    """Decode the poses of a message in CDR."""
    codec = codec_of(type_name, "cdr")
    assert codec is not None
    poses: list[StampedPose] = codec.decode(data)
    return poses
