"""ROS 1: bags, and its messages in MCAP. Nothing is lost, but a bag has no attachments."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

from mcap.writer import Writer as McapWriter
from rosbags.convert.converter import migrate_message
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from prim.log.messages import TF_TYPE
from tests.encodings.content import LATCHED, LogContent
from tests.encodings.ros2 import CHUNK_BYTES, add_records

OLD_TF_TYPE = "tf/msg/tfMessage"
"""What transforms were before tf2: the same fields."""
_TRANSFORMS = "geometry_msgs/TransformStamped[] transforms\n"


class Ros1Message(NamedTuple):
    """A message of a log in ROS 1's serialization."""

    topic: str
    log_time: int
    data: bytes


@cache
def ros1_types() -> Any:
    """Return the types of ROS 1 Noetic."""
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(_TRANSFORMS, TF_TYPE) | get_types_from_msg(_TRANSFORMS, OLD_TF_TYPE))
    return store


@cache
def ros2_types() -> Any:
    """Return the types of ROS 2 Jazzy."""
    return get_typestore(Stores.ROS2_JAZZY)


def to_ros1(content: LogContent) -> Iterator[Ros1Message]:
    """Convert all messages; headers are counted topic by topic in ``seq``, which ROS 2 does not have."""
    written: Counter[str] = Counter()
    plans: dict[str, object] = {}
    for topic, log_time, data in content.messages:
        kind = content.types[topic]
        message = ros2_types().deserialize_cdr(data, kind)
        converted: Any = migrate_message(ros2_types(), ros1_types(), kind, kind, plans, message)
        for part in (converted, *getattr(converted, "transforms", ()), *getattr(converted, "markers", ())):
            if hasattr(part, "header"):
                part.header.seq = written[topic]
        written[topic] += 1
        yield Ros1Message(topic, log_time, bytes(ros1_types().serialize_ros1(converted, kind)))


def write_bag(content: LogContent, folder: Path, compression: str = "", tf_type: str = TF_TYPE) -> Path:
    """Write a ROS 1 bag of several chunks.

    Args:
        content: The log.
        folder: Where the bag is written.
        compression: Of its chunks: nothing, «BZ2» or «LZ4».
        tf_type: The type of transforms.

    Returns:
        The bag.
    """
    bag = Writer(folder / "log.bag")
    bag.chunk_threshold = CHUNK_BYTES
    if compression:
        bag.set_compression(Writer.CompressionFormat[compression])
    with bag:
        connections = {
            topic: bag.add_connection(
                topic,
                tf_type if kind == TF_TYPE else kind,
                typestore=ros1_types(),
                callerid="/test",
                latching=int(topic in LATCHED),
            )
            for topic, kind in content.types.items()
        }
        for message in to_ros1(content):
            bag.write(connections[message.topic], message.log_time, message.data)
    return folder / "log.bag"


def write_bag_bz2(content: LogContent, folder: Path) -> Path:
    return write_bag(content, folder, "BZ2")


def write_bag_lz4(content: LogContent, folder: Path) -> Path:
    return write_bag(content, folder, "LZ4")


def write_bag_old_tf(content: LogContent, folder: Path) -> Path:
    return write_bag(content, folder, tf_type=OLD_TF_TYPE)


def write_mcap(content: LogContent, folder: Path) -> Path:
    """Write ROS 1 messages in MCAP, as the command ``mcap convert`` makes it of a bag."""
    stream = BytesIO()
    writer = McapWriter(stream, chunk_size=CHUNK_BYTES)
    writer.start(profile="ros1", library="test")
    channels = {}
    for topic, kind in content.types.items():
        definition, md5 = ros1_types().generate_msgdef(kind, ros_version=1)
        schema = writer.register_schema(kind.replace("/msg/", "/"), "ros1msg", definition.encode())
        described = {"callerid": "/test", "md5sum": md5, "latching": str(int(topic in LATCHED)), "topic": topic}
        channels[topic] = writer.register_channel(topic, "ros1", schema, described)
    add_records(writer, content)
    for message in to_ros1(content):
        writer.add_message(channels[message.topic], message.log_time, message.data, message.log_time)
    writer.finish()
    path = folder / "log.mcap"
    path.write_bytes(stream.getvalue())
    return path
