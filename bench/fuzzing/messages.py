"""Messages with wild values in every field, counts that lie, and ends that are missing, in all encodings."""

from __future__ import annotations

import math
import random
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, is_dataclass, replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from mcap.records import Channel, Message, Schema
from rosbags.typesys import Stores, get_typestore

from bench.fuzzing.case import Case
from bench.fuzzing.mcap_file import CHUNKED, Assembly, Chunked
from bench.fuzzing.samples import Samples
from prim.log.decoding.ros import decode_scan
from prim.log.messages import GPS_TOPIC, ODOM_TOPIC, SCAN_TOPIC, encode_scan
from tests.encodings.content import LogContent
from tests.encodings.ros1 import ros1_types

FLOATS = (
    math.nan, math.inf, -math.inf, 0.0, -0.0, 1e30, -1e30, 1e300, -1e308, 5e-324, 1e-310, 1e-40, 1e9, 1e12, -1e12,
    3.4e38, 2.0**31, 2.0**63, 1.0, -1.0, math.pi, 1e5, 3e3,
)  # fmt: skip
INTEGERS = (
    0, 1, -1, 2, 7, 100, 255, 65535, 65536, 1 << 20, (1 << 31) - 1, -(1 << 31), 1 << 31, (1 << 32) - 1, (1 << 63) - 1,
    1 << 62,
)  # fmt: skip
STRINGS = (
    "",
    "laser",
    "base_link",
    "odom",
    "map",
    "/",
    "a" * 5000,
    "é\u202e\x1b[2J\n",
    "\x00",
    "{}",
    "[" * 3000,
    "NaN",
)
COUNTS = (0, 1, 2, 1000)
"""Of the items that sequences get."""

MODES = (
    "--no-detect --mapper det",
    "--no-detect --mapper det --pose odom",
    "--no-detect --mapper det --pose tf",
    "--no-detect --mapper det --pose fused",
    "--no-detect --mapper prob",
    "--no-detect --mapper forward",
    "--no-detect --mapper det --match-scans --pose odom",
    "--no-detect --mapper det --clock log",
    "--pose odom",
)
"""Options with which such logs are replayed: they decide which values are used."""


class Substitute(NamedTuple):
    """A type of messages that stands in for another one on its topic.

    Attributes:
        topic: The topic.
        type: The type.
        convert: From the message of the sample, as rosbags has it, to the new one.
    """

    topic: str
    type: str
    convert: Callable[[Any], Any]


@cache
def ros2_types() -> Any:
    """Return the types of ROS 2."""
    return get_typestore(Stores.ROS2_JAZZY)


def _new(type_name: str, **values: Any) -> Any:
    return ros2_types().types[type_name](**values)


def _multi_echo(scan: Any) -> Any:
    echo = "sensor_msgs/msg/LaserEcho"
    shared = {
        f.name: getattr(scan, f.name) for f in fields(scan) if f.name not in ("ranges", "intensities", "__msgtype__")
    }
    ranges = [_new(echo, echoes=np.array([z], np.float32)) for z in scan.ranges]
    return _new("sensor_msgs/msg/MultiEchoLaserScan", **shared, ranges=ranges, intensities=[])


def _cloud(scan: Any) -> Any:
    bearings = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
    ranges = np.where(np.isfinite(scan.ranges), scan.ranges, np.nan)
    points = np.stack([ranges * np.cos(bearings), ranges * np.sin(bearings), 0 * ranges], axis=1).astype(np.float32)
    columns = [
        _new("sensor_msgs/msg/PointField", name=axis, offset=4 * k, datatype=7, count=1)
        for k, axis in enumerate("xyz")
    ]
    return _new(
        "sensor_msgs/msg/PointCloud2",
        header=scan.header,
        height=1,
        width=len(points),
        fields=columns,
        is_bigendian=False,
        point_step=12,
        row_step=12 * len(points),
        data=np.frombuffer(points.tobytes(), np.uint8),
        is_dense=False,
    )


def _pose_stamped(odometry: Any) -> Any:
    return _new("geometry_msgs/msg/PoseStamped", header=odometry.header, pose=odometry.pose.pose)


def _pose_with_covariance(odometry: Any) -> Any:
    return _new("geometry_msgs/msg/PoseWithCovarianceStamped", header=odometry.header, pose=odometry.pose)


def _fix(point: Any) -> Any:
    return _new(
        "sensor_msgs/msg/NavSatFix",
        header=point.header,
        status=_new("sensor_msgs/msg/NavSatStatus", status=0, service=1),
        latitude=52.0 + point.point.y / 111e3,
        longitude=13.0 + point.point.x / 68e3,
        altitude=30.0,
        position_covariance=np.zeros(9),
        position_covariance_type=0,
    )


SUBSTITUTES = (
    Substitute(SCAN_TOPIC, "sensor_msgs/msg/MultiEchoLaserScan", _multi_echo),
    Substitute(SCAN_TOPIC, "sensor_msgs/msg/PointCloud2", _cloud),
    Substitute(ODOM_TOPIC, "geometry_msgs/msg/PoseStamped", _pose_stamped),
    Substitute(ODOM_TOPIC, "geometry_msgs/msg/PoseWithCovarianceStamped", _pose_with_covariance),
    Substitute(GPS_TOPIC, "sensor_msgs/msg/NavSatFix", _fix),
)
"""Types that no sample holds."""


def wild_ros_messages(rng: random.Random, samples: Samples) -> Case:
    """Make a log of ROS messages, some of whose fields are wild.

    Args:
        rng: The source of randomness.
        samples: The intact logs.

    Returns:
        The case.
    """
    types, content = dict(samples.content.types), samples.content
    substitute = rng.choice((None, None, *SUBSTITUTES))
    topic = substitute.topic if substitute else rng.choice(list(types))
    kind = types[topic]
    types[topic] = substitute.type if substitute else kind
    is_ros1 = rng.random() < 0.25 and not _is_new_in_ros2(types)
    chosen = chosen_messages(rng, len(content.of(topic)))
    done, messages, at = "", [], 0
    for message in content.messages:
        data: Any = message.data
        if message.topic == topic or is_ros1:
            value = ros2_types().deserialize_cdr(message.data, content.types[message.topic])
            if message.topic == topic:
                value = substitute.convert(value) if substitute else value
                if at in chosen:
                    done, data = wild_message(rng, value, types[topic], is_ros1)
                else:
                    data = _serialized(value, types[topic], is_ros1)
                at += 1
            else:
                data = _serialized(value, types[message.topic], is_ros1)
        messages.append((message.topic, message.log_time, data))
    what = f"{len(chosen)} of {types[topic]}{' in ros1' if is_ros1 else ''}: {done}"
    options = ("--no-viewer", *rng.choice(MODES).split())
    return Case(what, {"log.mcap": _mcap(content, types, messages, is_ros1)}, options=options)


def _is_new_in_ros2(types: dict[str, str]) -> bool:
    """Return whether any type has other fields in ROS 1 than rosbags converts by itself."""
    return bool({"visualization_msgs/msg/MarkerArray", "tf2_msgs/msg/TFMessage"} & set(types.values()))


def chosen_messages(rng: random.Random, count: int) -> set[int]:
    """Choose which messages of a topic are damaged: one, some or all.

    Args:
        rng: The source of randomness.
        count: How many there are.

    Returns:
        Their indices.
    """
    share = rng.choice((0.0, 0.0, 0.3, 1.0))
    return {rng.randrange(count)} | {k for k in range(count) if rng.random() < share}


def wild_message(rng: random.Random, value: Any, kind: str, is_ros1: bool = False) -> tuple[str, bytes]:
    """Serialize a message with a field that is wild, or whose bytes are damaged.

    Args:
        rng: The source of randomness.
        value: The message as rosbags has it.
        kind: Its type in ROS 2.
        is_ros1: Whether it is serialized as in ROS 1.

    Returns:
        What was done, and the message.
    """
    how = rng.random()
    what = ""
    if how < 0.65:
        leaves = list(_leaves(value))
        for place in rng.sample(leaves, k=min(len(leaves), rng.choice((1, 1, 1, 2, 5)))):
            what = place.change(rng)
    data = _serialized(value, kind, is_ros1)
    if how < 0.65:
        return what, data
    return damaged_words(rng, data)


def damaged_words(rng: random.Random, data: bytes) -> tuple[str, bytes]:
    """Overwrite a word of a message by a wild number, or cut or lengthen it.

    Args:
        rng: The source of randomness.
        data: The message.

    Returns:
        What was done, and the message.
    """
    how = rng.choice(("word", "word", "double", "cut", "longer"))
    if how == "cut":
        at = rng.randrange(len(data) + 1)
        return f"cut at {at} of {len(data)}", data[:at]
    if how == "longer":
        return "lengthened", data + rng.randbytes(rng.choice((1, 4, 4096)))
    size = 8 if how == "double" else 4
    at = rng.randrange(max(1, len(data) // size)) * size + (4 if size == 8 else 0)
    integer = struct.pack("<q", rng.choice(INTEGERS) if rng.random() < 0.9 else rng.getrandbits(62))[:size]
    real = struct.pack("<d", rng.choice(FLOATS)) if size == 8 else struct.pack("<f", rng.choice(FLOATS_32))
    word = rng.choice((integer, real))
    return f"{word.hex()} at byte {at} of {len(data)}", (data[:at] + word + data[at + size :])[: len(data)]


FLOATS_32 = tuple(value for value in FLOATS if not math.isfinite(value) or abs(value) < 3.5e38)


class _Leaf(NamedTuple):
    """A place in a message that holds a number, a text or a sequence."""

    path: str
    value: Any
    put: Callable[[Any], None]

    def change(self, rng: random.Random) -> str:
        """Put something wild there; return what."""
        value = wild_value(rng, self.value)
        self.put(value)
        shown = f"{len(value)} items" if isinstance(value, np.ndarray | list) else repr(value)[:40]
        return f"{self.path} = {shown}"


def _leaves(value: Any, path: str = "") -> Iterator[_Leaf]:
    """Yield the places of a message: fields of base types, sequences, and their items."""
    for field in fields(value):
        item = getattr(value, field.name)
        if field.name == "__msgtype__" or field.name.isupper():
            continue
        where = f"{path}{field.name}"
        if is_dataclass(item):
            yield from _leaves(item, f"{where}.")
            continue
        yield _Leaf(where, item, lambda new, v=value, n=field.name: object.__setattr__(v, n, new))  # type: ignore[misc]
        if isinstance(item, list):
            for k, inner in enumerate(item):
                yield from _leaves(inner, f"{where}[{k}].")


def wild_value(rng: random.Random, value: Any) -> Any:
    """Return a wild value of the same type.

    Args:
        rng: The source of randomness.
        value: A number, text or sequence.

    Returns:
        The value.
    """
    if isinstance(value, bool):
        return not value
    if isinstance(value, int):
        return rng.choice(INTEGERS)
    if isinstance(value, float):
        return rng.choice(FLOATS)
    if isinstance(value, str):
        return rng.choice(STRINGS)
    if isinstance(value, list):
        return rng.choice(([], value * 2, value[:1] * 300))
    if isinstance(value, np.ndarray):
        return _wild_array(rng, value)
    return value


def _wild_array(rng: random.Random, values: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Change the length of a sequence, or some of its items."""
    is_fixed = len(values) in (9, 36)  # covariances: arrays of one length
    if not is_fixed and rng.random() < 0.3:
        return np.resize(values, rng.choice(COUNTS))
    changed = values.copy()
    share = rng.choice((0.05, 0.5, 1.0))
    for k in range(len(changed)):
        if rng.random() < share or k == 0:
            is_real = changed.dtype.kind == "f"
            changed[k] = rng.choice(FLOATS_32) if is_real else rng.randrange(256)
    return changed


def _serialized(value: Any, kind: str, is_ros1: bool) -> bytes:
    """Serialize a message; numbers that do not fit into their fields are wrapped."""
    store = ros1_types() if is_ros1 else ros2_types()
    serialize = store.serialize_ros1 if is_ros1 else store.serialize_cdr
    with np.errstate(all="ignore"):
        for bits in (64, 32, 31, 16, 8, 7):
            try:
                return bytes(serialize(value, kind))
            except (struct.error, OverflowError):
                _wrap(value, bits)
    return bytes(serialize(value, kind))


def _wrap(value: Any, bits: int) -> None:
    """Cut all whole numbers of a message to some bits."""
    for leaf in list(_leaves(value)):
        if isinstance(leaf.value, int) and not isinstance(leaf.value, bool):
            leaf.put(leaf.value % (1 << bits))
        if isinstance(leaf.value, float) and math.isfinite(leaf.value) and abs(leaf.value) > 3.4e38:
            leaf.put(math.copysign(3e38, leaf.value))


def _mcap(
    content: LogContent,
    types: dict[str, str],
    messages: Sequence[tuple[str, int, bytes]],
    is_ros1: bool,
    chunked: Chunked = CHUNKED,
) -> bytes:
    """Return an MCAP file of these messages."""
    file = Assembly(chunked, "ros1" if is_ros1 else "ros2")
    channels = {topic: number for number, topic in enumerate(types, 1)}
    for topic, number in channels.items():
        name = types[topic].replace("/msg/", "/") if is_ros1 else types[topic]
        file.add(Schema(id=number, data=b"", encoding="ros1msg" if is_ros1 else "ros2msg", name=name))
        encoding = "ros1" if is_ros1 else "cdr"
        file.add(Channel(id=number, topic=topic, message_encoding=encoding, metadata={}, schema_id=number))
    for topic, log_time, data in messages:
        file.add(message_record(channels[topic], log_time, data))
    return file.finish()


def message_record(channel: int, log_time: int, data: bytes) -> Message:
    """Return a message of a channel, logged (ns) when it was published."""
    return Message(channel_id=channel, log_time=log_time, data=data, publish_time=log_time, sequence=0)


MATCHED_BEAMS = 100
"""Scans of more beams are not matched: that takes a tenth of a second for each, however large the log is."""


def wild_scans(rng: random.Random, samples: Samples) -> Case:
    """Make scans of many beams or long ranges, as a stranger's scanner has them: nothing is damaged, nor packed.

    What a mapper takes is measured by the rays that there are, however well these could be packed.

    Args:
        rng: The source of randomness.
        samples: The intact logs.

    Returns:
        The case.
    """
    content = samples.content
    far, share = rng.choice((1e2, 3e3, 1e5, 1e7, 1e20)), rng.choice((0.02, 0.3, 1.0))
    beams = rng.choice((1, 2, 25, 1000, 20_000))
    messages = []
    for topic, log_time, data in content.messages:
        if topic == SCAN_TOPIC:
            scan = decode_scan(data)
            ranges = np.resize(scan.ranges, beams)
            ranges[[rng.random() < share for _ in range(beams)]] = far
            step = scan.angle_increment * len(scan.ranges) / beams
            scan = replace(scan, ranges=ranges, range_max=rng.choice((far, 2 * far, math.inf)), angle_increment=step)
            data = encode_scan(replace(scan, angle_max=scan.angle_min + step * (beams - 1)))
        messages.append((topic, log_time, data))
    what = f"{beams} beams, {share:.0%} of them {far:g} m"
    modes = [mode for mode in MODES if beams <= MATCHED_BEAMS or "--match-scans" not in mode]
    log = _mcap(content, content.types, messages, False, Chunked(compression=""))
    return Case(what, {"log.mcap": log}, options=("--no-viewer", *rng.choice(modes).split()))
