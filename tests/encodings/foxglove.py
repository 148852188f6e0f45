"""Foxglove's own messages in MCAP, as protobuf and as JSON: scans and transforms.

Lost: ``range_min`` and ``range_max`` (there are no limits), ``time_increment`` and ``scan_time``; in JSON, too, which
ranges were infinite: as JavaScript does it, whatever is not finite is null.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.LaserScan_pb2 import LaserScan
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.writer import Writer

from prim.log.decoding.cdr import SECOND
from prim.log.decoding.ros import decode_scan
from prim.log.decoding.values import StampedPose
from prim.log.messages import SCAN_TOPIC, SCAN_TYPE, TF_STATIC_TOPIC, TF_TOPIC, TF_TYPE, encode_scan
from prim.log.source import Message
from prim.scan import Scan
from tests.encodings.content import LogContent, decode_poses, mapped
from tests.encodings.ros2 import CHUNK_BYTES

ROS_TYPES = {SCAN_TOPIC: SCAN_TYPE, TF_TOPIC: TF_TYPE, TF_STATIC_TOPIC: TF_TYPE}
"""The topics that are written, and their types in ROS 2."""
PROTOBUF_CLASSES = {SCAN_TOPIC: LaserScan, TF_TOPIC: FrameTransform, TF_STATIC_TOPIC: FrameTransforms}


def write_protobuf(content: LogContent, folder: Path) -> Path:
    schemas = {topic: _descriptors(kind.DESCRIPTOR.file) for topic, kind in PROTOBUF_CLASSES.items()}
    return _write(content, folder, "protobuf", "protobuf", schemas)


def write_json(content: LogContent, folder: Path) -> Path:
    """Write as JavaScript's JSON.stringify does."""
    return _write(content, folder, "json", "jsonschema", dict.fromkeys(ROS_TYPES, b'{"type": "object"}'))


def reduce_to_protobuf(content: LogContent) -> LogContent:
    """Reduce a session to what is written."""
    return mapped(content, ROS_TYPES, lambda message: [_without_limits(message, keeps_infinite=True)])


def reduce_to_json(content: LogContent) -> LogContent:
    """Reduce a session to what is written."""
    return mapped(content, ROS_TYPES, lambda message: [_without_limits(message, keeps_infinite=False)])


def _write(content: LogContent, folder: Path, encoding: str, schema_encoding: str, schemas: dict[str, bytes]) -> Path:
    stream = BytesIO()
    writer = Writer(stream, chunk_size=CHUNK_BYTES)
    writer.start(profile="", library="test")
    channels = {}
    for topic, data in schemas.items():
        schema = writer.register_schema(PROTOBUF_CLASSES[topic].DESCRIPTOR.full_name, schema_encoding, data)
        channels[topic] = writer.register_channel(topic, encoding, schema)
    for message in content.messages:
        if message.topic not in ROS_TYPES:
            continue
        for values in _messages(message):
            data = (
                PROTOBUF_CLASSES[message.topic](**_protobuf_values(values)).SerializeToString()
                if encoding == "protobuf"
                else json.dumps(_json_values(values), allow_nan=False).encode()
            )
            writer.add_message(channels[message.topic], message.log_time, data, message.log_time)
    writer.finish()
    path = folder / "log.mcap"
    path.write_bytes(stream.getvalue())
    return path


def _messages(message: Message) -> list[dict[str, Any]]:
    """Return the Foxglove messages that a message becomes; times are in ns."""
    if message.topic == SCAN_TOPIC:
        return [_laser_scan(decode_scan(message.data))]
    transforms = [_frame_transform(pose) for pose in decode_poses(TF_TYPE, message.data)]
    return [{"transforms": transforms}] if message.topic == TF_STATIC_TOPIC else transforms


def _laser_scan(scan: Scan) -> dict[str, Any]:
    return {
        "timestamp": scan.stamp,
        "frame_id": scan.frame_id,
        "pose": {"position": {"x": 0.0, "y": 0.0, "z": 0.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}},
        "start_angle": scan.angle_min,
        "end_angle": scan.angle_min + scan.angle_increment * (len(scan.ranges) - 1),
        "ranges": scan.ranges.tolist(),
        "intensities": [],
    }


def _frame_transform(pose: StampedPose) -> dict[str, Any]:
    return {
        "timestamp": pose.stamp,
        "parent_frame_id": pose.frame_id,
        "child_frame_id": pose.child_frame_id,
        "translation": dict(zip("xyz", pose.translation, strict=True)),
        "rotation": dict(zip("xyzw", pose.rotation, strict=True)),
    }


def _protobuf_values(values: dict[str, Any]) -> dict[str, Any]:
    if "transforms" in values:
        return {"transforms": [_protobuf_values(transform) for transform in values["transforms"]]}
    seconds, nanoseconds = divmod(values["timestamp"], SECOND)
    return {**values, "timestamp": {"seconds": seconds, "nanos": nanoseconds}}


def _json_values(values: dict[str, Any]) -> dict[str, Any]:
    if "transforms" in values:
        return {"transforms": [_json_values(transform) for transform in values["transforms"]]}
    seconds, nanoseconds = divmod(values["timestamp"], SECOND)
    ranges = {"ranges": [z if math.isfinite(z) else None for z in values["ranges"]]} if "ranges" in values else {}
    return {**values, "timestamp": {"sec": seconds, "nsec": nanoseconds}, **ranges}


def _descriptors(file: FileDescriptor) -> bytes:
    """Return a FileDescriptorSet of a file and of all that it imports, what is imported first."""
    found: dict[str, FileDescriptor] = {}

    def add(file: FileDescriptor) -> None:
        for dependency in file.dependencies:
            add(dependency)
        found.setdefault(file.name, file)

    add(file)
    files = FileDescriptorSet()
    for each in found.values():
        each.CopyToProto(files.file.add())
    return files.SerializeToString()


def _without_limits(message: Message, keeps_infinite: bool) -> bytes:
    if message.topic != SCAN_TOPIC:
        return message.data
    scan = decode_scan(message.data)
    ranges = scan.ranges if keeps_infinite else np.where(np.isfinite(scan.ranges), scan.ranges, np.float32(np.nan))
    limits = {"range_min": 0.0, "range_max": math.inf, "time_increment": 0.0, "scan_time": 0.0}
    return encode_scan(replace(scan, ranges=ranges, **limits))
