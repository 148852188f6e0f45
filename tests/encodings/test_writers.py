"""What the writers write is read back by other software: mcap, rosbags, zstandard, protobuf, json; CARMEN by hand."""

from __future__ import annotations

import gzip
import json
import math
from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import zstandard
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message_factory import GetMessages
from mcap.reader import NonSeekingReader, make_reader
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2 import Reader as Ros2Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from prim.log.decoding.ros import decode_scan
from prim.log.decoding.values import planar_pose
from prim.log.messages import ODOM_TOPIC, SCAN_TOPIC, TF_STATIC_TOPIC, TF_TOPIC, TF_TYPE, encode_scan
from prim.log.source import Message
from prim.scan import Scan
from prim.se2 import Pose2D
from tests.encodings import carmen, foxglove, ros1, ros2
from tests.encodings.content import LogContent, decode_poses, remounted
from tests.encodings.table import ENCODINGS, Encoding

ZSTD, GZIP = b"\x28\xb5\x2f\xfd", b"\x1f\x8b"
BY_NAME = {encoding.name: encoding for encoding in ENCODINGS}


class Stored(NamedTuple):
    """A message as another reader finds it, with its type (ROS 2's name) and how both are serialized."""

    topic: str
    log_time: int
    type: str
    encoding: str
    definition: str | bytes
    data: bytes


def decompressed(path: Path) -> Path:
    """The file itself, or what is compressed in it, beside it."""
    data = path.read_bytes()
    if data.startswith(ZSTD):
        data = zstandard.ZstdDecompressor().decompressobj().decompress(data)
    elif data.startswith(GZIP):
        data = gzip.decompress(data)
    else:
        return path
    plain = path.with_suffix("")
    plain.write_bytes(data)
    return plain


def read_mcap(path: Path) -> Iterator[Stored]:
    with path.open("rb") as stream:
        for schema, channel, message in NonSeekingReader(stream).iter_messages(log_time_order=True):
            name = schema.name.replace("/msg/", "/").replace("/", "/msg/")
            definition = schema.data if schema.encoding == "protobuf" else schema.data.decode()
            data = zstandard.decompress(message.data) if message.data.startswith(ZSTD) else message.data
            yield Stored(channel.topic, message.log_time, name, channel.message_encoding, definition, data)


def read_rosbags(path: Path) -> Iterator[Stored]:
    kind, encoding = (Ros1Reader, "ros1") if path.suffix == ".bag" else (Ros2Reader, "cdr")
    with kind(path) as bag:
        for connection, log_time, data in bag.messages():
            plain = zstandard.decompress(data) if bytes(data).startswith(ZSTD) else data
            definition = connection.msgdef.data
            yield Stored(connection.topic, log_time, connection.msgtype, encoding, definition, bytes(plain))


def read_back(path: Path) -> list[Stored]:
    path = path if path.is_dir() else decompressed(path)
    return list((read_mcap if path.suffix == ".mcap" else read_rosbags)(path))


def assert_same_fields(ros1_message: Any, ros2_message: Any) -> None:
    """All fields of ROS 2's message that ROS 1's has are equal; no other than these may be missing."""
    ours = {field.name for field in fields(ros1_message)}
    for field in fields(ros2_message):
        if field.name.isupper() or field.name == "__msgtype__":  # constants of the definition
            continue
        if field.name not in ours:
            assert field.name in {"texture_resource", "texture", "uv_coordinates", "mesh_file"}
            continue
        a, b = getattr(ros1_message, field.name), getattr(ros2_message, field.name)
        if isinstance(a, list):
            assert len(a) == len(b)
            for pair in zip(a, b, strict=True):
                assert_same_fields(*pair)
        elif is_dataclass(a):
            assert_same_fields(a, b)
        else:
            assert np.array_equal(a, b, equal_nan=isinstance(a, np.ndarray))


def in_order(content: LogContent) -> list[Message]:
    return sorted(content.messages, key=lambda message: message.log_time)


@pytest.mark.parametrize("encoding", [e for e in ENCODINGS if e.lossless], ids=lambda encoding: encoding.name)
def test_lossless_encodings_hold_every_message(content: LogContent, tmp_path: Path, encoding: Encoding) -> None:
    stored = read_back(encoding.write(content, tmp_path))
    assert [(s.topic, s.log_time) for s in stored] == [(m.topic, m.log_time) for m in in_order(content)]
    if stored[0].encoding == "cdr":
        assert [(s.type, s.data) for s in stored] == [(content.types[m.topic], m.data) for m in in_order(content)]
        return
    store, ros2_store = get_typestore(Stores.EMPTY), get_typestore(Stores.ROS2_JAZZY)
    for each in {s.type: s for s in stored}.values():
        store.register(get_types_from_msg(str(each.definition), each.type))
    for s, message in zip(stored, in_order(content), strict=True):
        kind = content.types[message.topic]
        assert s.type == kind or (s.type, kind) == (ros1.OLD_TF_TYPE, TF_TYPE)
        expected = ros2_store.deserialize_cdr(message.data, kind)
        assert_same_fields(store.deserialize_ros1(s.data, s.type), expected)


@pytest.mark.parametrize("name", ["bag", "bag-bz2", "bag-lz4", "mcap-folder", "db3-folder", "db3"])
def test_definitions_fit_their_hashes(content: LogContent, tmp_path: Path, name: str) -> None:
    """AnyReader compares the definitions that a bag holds with their hashes."""
    with AnyReader([BY_NAME[name].write(content, tmp_path)]) as bag:
        assert bag.message_count == len(content.messages)


def test_headers_of_ros1_are_counted(content: LogContent) -> None:
    messages = [message for message in ros1.to_ros1(content) if message.topic == SCAN_TOPIC]
    assert [int.from_bytes(message.data[:4], "little") for message in messages] == list(range(len(messages)))


@pytest.mark.parametrize(
    ("name", "compression", "indexed"),
    [
        ("mcap", {"zstd"}, True),
        ("mcap-lz4", {"lz4"}, True),
        ("mcap-uncompressed", {""}, True),
        ("mcap-zstd-messages", {""}, True),
        ("mcap-unchunked", set(), True),
        ("mcap-unindexed", set(), False),
        ("mcap-unindexed-unchunked", set(), False),
        ("mcap-ros1", {"zstd"}, True),
    ],
)
def test_mcap_is_of_the_kind_that_it_should_be(
    content: LogContent, tmp_path: Path, name: str, compression: set[str], indexed: bool
) -> None:
    path = BY_NAME[name].write(content, tmp_path)
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
        assert make_reader(stream).get_header().profile == ("ros1" if name == "mcap-ros1" else "ros2")
    chunks = summary.chunk_indexes if summary else []
    assert (summary is not None and bool(summary.channels)) == indexed
    assert {chunk.compression for chunk in chunks} == compression and len(chunks) != 1


@pytest.mark.parametrize("name", ["mcap", "mcap.zst", "mcap.gz", "mcap-ros1"])
def test_mcap_holds_metadata_and_attachments(content: LogContent, tmp_path: Path, name: str) -> None:
    with decompressed(BY_NAME[name].write(content, tmp_path)).open("rb") as stream:
        reader = make_reader(stream)
        assert {a.name: a.data for a in reader.iter_attachments()} == content.attachments
        assert {m.name: m.metadata for m in reader.iter_metadata()} == content.metadata


@pytest.mark.parametrize(
    ("name", "count", "suffix"),
    [
        ("mcap-split", ros2.SPLITS, ".mcap"),
        ("mcap-split-zstd-file", ros2.SPLITS, ".zstd"),
        ("db3-split", ros2.MANY_SPLITS, ".db3"),
        ("db3-split-zstd-file", ros2.SPLITS, ".zstd"),
    ],
)
def test_the_mount_is_in_the_first_part_alone(
    content: LogContent, tmp_path: Path, name: str, count: int, suffix: str
) -> None:
    bag = BY_NAME[name].write(content, tmp_path)
    files = [bag / f"bag_{k}{'.mcap' if 'mcap' in name else '.db3'}" for k in range(count)]
    compressed = [file.with_suffix(file.suffix + ".zstd") if suffix == ".zstd" else file for file in files]
    assert sorted(bag.iterdir()) == sorted([*compressed, bag / "metadata.yaml"])
    topics = [{s.topic for s in read_back(file)} for file in compressed]
    assert [TF_STATIC_TOPIC in found for found in topics] == [True] + [False] * (count - 1)
    assert all(SCAN_TOPIC in found for found in topics)


@pytest.mark.parametrize("name", ["mcap-folder", "db3-folder"])
@pytest.mark.parametrize("mode", ["", "-zstd-file", "-zstd-messages"])
def test_bags_are_compressed_as_the_name_says(content: LogContent, tmp_path: Path, name: str, mode: str) -> None:
    bag = BY_NAME[name + mode].write(content, tmp_path)
    (data,) = (file.read_bytes() for file in bag.iterdir() if file.name != "metadata.yaml")
    assert data.startswith(ZSTD) == (mode == "-zstd-file")
    assert (data.count(ZSTD) >= len(content.messages)) == (mode == "-zstd-messages")


def reduced_scans(content: LogContent) -> list[Scan]:
    return [decode_scan(message.data) for message in content.of(SCAN_TOPIC)]


def test_foxglove_protobuf_is_read_by_its_own_schema(content: LogContent, tmp_path: Path) -> None:
    stored = read_back(foxglove.write_protobuf(content, tmp_path))
    scans = iter(reduced_scans(foxglove.reduce_to_protobuf(content)))
    transforms = []
    for s in stored:
        files = FileDescriptorSet.FromString(s.definition)
        message = GetMessages(files.file)[s.type].FromString(s.data)
        if s.topic == SCAN_TOPIC:
            scan = next(scans)
            stamp = message.timestamp.seconds * 10**9 + message.timestamp.nanos
            assert (stamp, message.frame_id, message.start_angle) == (scan.stamp, scan.frame_id, scan.angle_min)
            increment = (message.end_angle - message.start_angle) / (len(message.ranges) - 1)
            assert np.float32(increment) == scan.angle_increment
            assert np.array_equal(np.array(message.ranges, np.float32), scan.ranges, equal_nan=True)
        else:
            transforms += message.transforms if s.topic == TF_STATIC_TOPIC else [message]
    assert next(scans, None) is None
    assert_same_transforms(content, [(t.timestamp.seconds, t.translation, t.rotation) for t in transforms])


def assert_same_transforms(content: LogContent, found: list[tuple[int, Any, Any]]) -> None:
    messages = [m for m in in_order(content) if m.topic in (TF_TOPIC, TF_STATIC_TOPIC)]
    expected = [pose for m in messages for pose in decode_poses(TF_TYPE, m.data)]
    assert [seconds for seconds, _, _ in found] == [pose.stamp // 10**9 for pose in expected]
    assert [(t.x, t.y, t.z) for _, t, _ in found] == [pose.translation for pose in expected]
    assert [(q.x, q.y, q.z, q.w) for _, _, q in found] == [pose.rotation for pose in expected]


def test_foxglove_json_is_strict_and_knows_no_infinity(content: LogContent, tmp_path: Path) -> None:
    stored = read_back(foxglove.write_json(content, tmp_path))
    values: dict[str, list[Any]] = {s.topic: [] for s in stored}
    for s in stored:
        values[s.topic].append(json.loads(s.data, parse_constant=pytest.fail))
    scans = reduced_scans(foxglove.reduce_to_json(content))
    for value, scan in zip(values[SCAN_TOPIC], scans, strict=True):
        ranges = np.array([math.nan if z is None else z for z in value["ranges"]], np.float32)
        assert np.array_equal(ranges, scan.ranges, equal_nan=True)
        assert value["timestamp"]["sec"] * 10**9 + value["timestamp"]["nsec"] == scan.stamp
    poses = [decode_poses(TF_TYPE, message.data)[0] for message in content.of(TF_TOPIC)]
    assert [tuple(v["translation"].values()) for v in values[TF_TOPIC]] == [pose.translation for pose in poses]
    assert values[TF_STATIC_TOPIC][0]["transforms"][0]["child_frame_id"] == "laser"


def lines(path: Path, name: str) -> list[list[str]]:
    """The fields of all lines of one kind, without the kind."""
    text = decompressed(path).read_text(encoding="ascii")
    return [line.split()[1:] for line in text.splitlines() if line.split()[0] == name]


def carmen_stamp(fields: list[str]) -> int:
    """The time that all lines end in, with a host's name and the time since the log's start."""
    stamp, host, since_start = fields[-3:]
    assert host == "robot" and 0 <= float(since_start) < 10
    seconds, fraction = stamp.split(".")
    return int(seconds) * 10**9 + int(fraction) * 1000


@pytest.mark.parametrize(
    ("name", "kind", "mount"),
    [
        ("carmen-flaser", "FLASER", Pose2D()),
        ("carmen-flaser-gz", "FLASER", Pose2D(0.1, 0.02, 0.0)),
        ("carmen-rlaser", "RLASER", Pose2D(-0.1, 0.0, math.pi)),
        ("carmen-robotlaser", "ROBOTLASER1", Pose2D(0.1, 0.0, 0.3)),
    ],
)
def test_carmen_holds_rounded_scans_and_odometry(
    content: LogContent, tmp_path: Path, name: str, kind: str, mount: Pose2D
) -> None:
    session = remounted(content, mount)
    path = BY_NAME[name].write(session, tmp_path)
    reduced = carmen.reduce_to_carmen(session)
    odometry = [decode_poses(carmen.ROS_TYPES[ODOM_TOPIC], m.data)[0] for m in reduced.of(ODOM_TOPIC)]
    for found, pose in zip(lines(path, "ODOM"), odometry, strict=True):
        assert len(found) == 9 and carmen_stamp(found) == pose.stamp
        plane = planar_pose(pose)
        assert [float(v) for v in found[:3]] == pytest.approx([plane.x, plane.y, plane.theta], abs=1e-12)
    scans, recorded = reduced_scans(reduced), reduced_scans(session)
    for found, scan, whole, robot in zip(lines(path, kind), scans, recorded, odometry, strict=True):
        head, count = (7, int(found[7])) if kind == "ROBOTLASER1" else (0, int(found[0]))
        if kind == "ROBOTLASER1":
            assert float(found[4]) == pytest.approx(scan.range_max)
            assert [np.float32(found[1]), np.float32(found[3])] == [scan.angle_min, scan.angle_increment]
            assert float(found[2]) == pytest.approx(scan.angle_increment * (count - 1))
            assert found[head + 1 + count] == "0"
        ranges = np.array(found[head + 1 : head + 1 + count], float)
        rest = [float(v) for v in found[head + 1 + count + (kind == "ROBOTLASER1") : -3]]
        assert len(rest) == (11 if kind == "ROBOTLASER1" else 6) and carmen_stamp(found) == scan.stamp
        assert np.array_equal(ranges.astype(np.float32), scan.ranges)
        measured = scan.measured
        assert np.abs(ranges - whole.ranges)[measured].max() <= 0.005 + 1e-7
        assert (ranges[whole.ranges == np.inf] == float(f"{scan.range_max:.2f}")).all()
        assert (ranges[~np.isfinite(whole.ranges) & (whole.ranges != np.inf)] == 0).all()
        laser, base = Pose2D(*rest[:3]), Pose2D(*rest[3:6])
        on_robot = base.inverse() @ laser
        assert (on_robot.x, on_robot.y) == pytest.approx((mount.x, mount.y), abs=1e-5)
        assert math.cos(on_robot.theta - mount.theta) == pytest.approx(1, abs=1e-9)
        assert (base.x, base.y) == pytest.approx(robot.translation[:2], abs=1e-12)
    limits = {fields[0]: float(fields[1]) for fields in lines(path, "PARAM")}
    assert limits["robot_front_laser_max"] == pytest.approx(scans[0].range_max)
    assert limits["robot_frontlaser_offset"] == pytest.approx(mount.x)


@pytest.mark.parametrize(("beams", "fits"), [(181, True), (180, True), (179, False), (90, False)])
def test_flaser_refuses_angles_that_it_does_not_know(
    content: LogContent, tmp_path: Path, beams: int, fits: bool
) -> None:
    """The scanner's beams are a degree apart: half a turn has 180 of them, or 181 with both ends."""
    (whole, *_) = reduced_scans(content)
    data = encode_scan(replace(whole, ranges=whole.ranges[:beams]))
    messages = [m._replace(data=data) if m.topic == SCAN_TOPIC else m for m in content.messages]
    session = replace(content, messages=tuple(messages))
    if fits:
        carmen.write_flaser(session, tmp_path)
    else:
        with pytest.raises(ValueError, match="no such angles"):
            carmen.write_flaser(session, tmp_path)
