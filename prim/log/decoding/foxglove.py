"""Foxglove's own messages, as protobuf or as JSON (https://docs.foxglove.dev/docs/visualization/message-schemas).

Both are read by the names of their fields; the readers here raise ValueError where there is no such message.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any

import numpy as np

from prim import strict_json
from prim.log.decoding.cdr import MAX_ITEMS, SECOND
from prim.log.decoding.values import (
    PointCloud,
    StampedFix,
    StampedPose,
    checked_count,
    checked_stamp,
    planar_pose,
    plane_variance,
)
from prim.scan import MAX_BEAMS, Scan
from prim.se2 import Pose2D

NUMPY_TYPES = {1: "u1", 2: "i1", 3: "u2", 4: "i2", 5: "u4", 6: "i4", 7: "f4", 8: "f8"}
"""The numeric types of foxglove.PackedElementField, and what they mean to NumPy."""

NUMERIC_TYPES = {
    name: number
    for number, name in enumerate(("UINT8", "INT8", "UINT16", "INT16", "UINT32", "INT32", "FLOAT32", "FLOAT64"), 1)
}
"""Their names, as protobuf's own JSON has them."""

MAX_JSON_ITEMS = 1 << 20
"""A message in JSON has no more values: each takes up to 240 bytes of memory; set by hand."""

MAX_SHIFT = 1e-6
"""A laser's origin farther than this (m) from its frame's is not at it."""


class JsonFields:
    """A message in JSON whose fields are attributes, as in protobuf; a missing one is 0 or empty.

    Args:
        fields: The JSON object.
    """

    def __init__(self, fields: dict[str, Any]) -> None:
        self._fields = fields

    def __getattr__(self, name: str) -> Any:
        return _as_fields(self._fields.get(name, _Missing()))


class _Missing(JsonFields):
    """A field that is not there: 0, empty, and without fields of its own."""

    def __init__(self) -> None:
        super().__init__({})

    def __float__(self) -> float:
        return 0.0

    def __int__(self) -> int:
        return 0

    def __str__(self) -> str:
        return ""

    def __iter__(self) -> Any:
        return iter(())

    def __len__(self) -> int:
        return 0

    def __bool__(self) -> bool:
        return False


class _Null(_Missing):
    """A field that is null: a number that is NaN, else as one that is not there."""

    def __float__(self) -> float:
        return math.nan


def _as_fields(value: Any) -> Any:
    if value is None:
        return _Null()
    if isinstance(value, dict):
        return JsonFields(value)
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return [_as_fields(item) for item in value]
    return value


def parse_json(data: bytes) -> Any:
    """Parse a message in JSON. Raises ValueError."""
    if sum(map(data.count, (b",", b"[", b"{"))) > MAX_JSON_ITEMS:
        raise ValueError(f"a message in JSON of more than {MAX_JSON_ITEMS} values")
    value = strict_json.loads(data)
    if not isinstance(value, dict):
        raise ValueError("a message in JSON that is no object")
    return JsonFields(value)


def protobuf_parser(name: str) -> Callable[[bytes], Any]:
    """Return the parser of a message type in protobuf, which raises ValueError.

    Args:
        name: The type's name, such as «LaserScan».

    Returns:
        From bytes to a message.
    """
    from google.protobuf.message import DecodeError

    message_type = _message_type(name)

    def parse(data: bytes) -> Any:
        check_field_count(data)
        try:
            return message_type.FromString(data)
        except DecodeError as error:
            raise ValueError(f"no foxglove.{name} in protobuf: {error}") from error

    return parse


def check_field_count(data: bytes) -> None:
    """Raise ValueError where a message in protobuf has too many fields: one of 2 bytes takes 150 of memory."""
    at, count = 0, 0
    try:
        while at < len(data):
            count += 1
            if count > MAX_ITEMS:
                raise ValueError(f"a message in protobuf of more than {MAX_ITEMS} fields")
            tag, at = _varint(data, at)
            if tag & 7 == _LENGTH_DELIMITED:
                size, at = _varint(data, at)
                at += size
            elif tag & 7 == _VARINT:
                _, at = _varint(data, at)
            else:
                at += _FIXED_BYTES.get(tag & 7, 0)
    except IndexError:
        return  # an error when it is parsed


_VARINT, _LENGTH_DELIMITED = 0, 2
_FIXED_BYTES = {1: 8, 5: 4}
"""The wire types of protobuf (https://protobuf.dev/programming-guides/encoding/)."""


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """Return the number of up to ten bytes that begins at a byte, and where it ends. Raises IndexError."""
    value = 0
    for shift in range(0, 70, 7):
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
    raise IndexError


def _message_type(name: str) -> Any:
    from foxglove_schemas_protobuf import (
        FrameTransform_pb2,
        FrameTransforms_pb2,
        LaserScan_pb2,
        LocationFix_pb2,
        PointCloud_pb2,
        PoseInFrame_pb2,
    )

    modules = {
        "FrameTransform": FrameTransform_pb2,
        "FrameTransforms": FrameTransforms_pb2,
        "LaserScan": LaserScan_pb2,
        "LocationFix": LocationFix_pb2,
        "PointCloud": PointCloud_pb2,
        "PoseInFrame": PoseInFrame_pb2,
    }
    return getattr(modules[name], name)


def read_scan(message: Any) -> Scan:
    """Read a foxglove.LaserScan: without limits of the range, and without the time of a sweep."""
    absent = [name for name in ("start_angle", "end_angle", "ranges") if type(getattr(message, name)) is _Missing]
    if absent:
        raise ValueError(f"a scan without {absent[0]}")
    if len(message.ranges) > MAX_BEAMS:
        raise ValueError(f"a scan of {len(message.ranges)} beams, more than {MAX_BEAMS}")
    ranges = np.array([_number(z) for z in message.ranges] if _is_json(message) else message.ranges, dtype=np.float32)
    first, last = float(message.start_angle), float(message.end_angle)
    increment = (last - first) / (len(ranges) - 1) if len(ranges) > 1 else 0.0
    turn = _turn_of_origin(message)
    return Scan(
        read_stamp(message),
        _text(message.frame_id),
        first + turn,
        increment,
        0.0,
        math.inf,
        ranges,
        angle_max=last + turn,
    )


def _turn_of_origin(message: Any) -> float:
    """Return by how much a scan's bearings are turned in its frame (rad)."""
    pose = _pose(message.pose, 0, "", "")
    if math.hypot(*pose.translation) > MAX_SHIFT:
        raise ValueError("its pose moves the laser within its frame: give that as a transform")
    return planar_pose(pose).theta if any(pose.rotation) else 0.0


def read_cloud(message: Any) -> PointCloud:
    """Read a foxglove.PointCloud that has x, y and, unless it is flat, z."""
    turn = _turn_of_origin(message)
    data = _octets(message.data)
    stride = int(message.point_stride)
    fields = {_text(field.name): (int(field.offset), _numeric_type(field.type)) for field in message.fields}
    if stride < 1 or len({"x", "y"} & fields.keys()) < 2:
        raise ValueError("a cloud without x and y")
    points = np.zeros((checked_count(len(data) // stride), 3))
    for k, axis in enumerate("xyz"):
        if axis in fields and len(points):
            offset, kind = fields[axis]
            if kind not in NUMPY_TYPES or offset < 0 or offset + np.dtype(NUMPY_TYPES[kind]).itemsize > stride:
                raise ValueError(f"{axis} of a cloud cannot be read")
            points[:, k] = np.ndarray(len(points), "<" + NUMPY_TYPES[kind], data, offset, (stride,))
    points[:, :2] = Pose2D(0.0, 0.0, turn).apply(points[:, :2])
    return PointCloud(read_stamp(message), _text(message.frame_id), points)


def _numeric_type(value: Any) -> int:
    """Return a numeric type, which JSON may name."""
    return NUMERIC_TYPES.get(value, 0) if isinstance(value, str) else int(value)


def read_transform(message: Any) -> list[StampedPose]:
    """Read a foxglove.FrameTransform."""
    return [
        StampedPose(
            read_stamp(message),
            _text(message.parent_frame_id),
            _text(message.child_frame_id),
            _xyz(message.translation),
            _rotation(message.rotation),
        )
    ]


def read_transforms(message: Any) -> list[StampedPose]:
    """Read a foxglove.FrameTransforms."""
    return [pose for transform in message.transforms for pose in read_transform(transform)]


def read_pose(message: Any) -> list[StampedPose]:
    """Read a foxglove.PoseInFrame."""
    return [_pose(message.pose, read_stamp(message), _text(message.frame_id), "")]


def read_fix(message: Any) -> StampedFix:
    """Read a foxglove.LocationFix: latitude, longitude, altitude and their variance in the plane."""
    place = (_number(message.latitude), _number(message.longitude), _number(message.altitude))
    covariance = message.position_covariance
    numbers = [_number(value) for value in covariance] if len(covariance) == 9 else []
    kind = message.position_covariance_type
    variance = plane_variance(numbers, not isinstance(kind, _Missing) and kind not in (0, "UNKNOWN"))
    return StampedFix(read_stamp(message), _text(message.frame_id), *place, variance)


def read_stamp(message: Any) -> int:
    """Read a message's timestamp (ns)."""
    stamp = message.timestamp
    if isinstance(stamp, _Missing):
        return 0
    if isinstance(stamp, str):  # as protobuf's own JSON has it (RFC 3339)
        time = datetime.fromisoformat(stamp)
        return checked_stamp(round((time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp() * SECOND))
    if not isinstance(stamp, JsonFields):
        if not hasattr(stamp, "nanos"):
            raise ValueError(f"its timestamp, {strict_json.shown(stamp)}, is none of seconds and nanoseconds")
        return checked_stamp(int(stamp.seconds) * SECOND + int(stamp.nanos))
    for seconds, nanoseconds in ((stamp.sec, stamp.nsec), (stamp.sec, stamp.nanosec), (stamp.seconds, stamp.nanos)):
        if not isinstance(seconds, _Missing) and not isinstance(nanoseconds, _Missing):
            return checked_stamp(int(seconds) * SECOND + int(nanoseconds))
    raise ValueError("its timestamp has no sec and nsec")


def first_stamp(message: Any) -> int:
    """Read the stamp (ns) of the first transform of a foxglove.FrameTransforms; 0 of an empty one."""
    return next((read_stamp(transform) for transform in message.transforms), 0)


def _pose(pose: Any, stamp: int, frame_id: str, child_frame_id: str) -> StampedPose:
    return StampedPose(stamp, frame_id, child_frame_id, _xyz(pose.position), _rotation(pose.orientation))


def _rotation(quaternion: Any) -> tuple[float, float, float, float]:
    return (*_xyz(quaternion), _number(quaternion.w))


def _xyz(vector: Any) -> tuple[float, float, float]:
    return _number(vector.x), _number(vector.y), _number(vector.z)


def _number(value: Any) -> float:
    """Return a number; JSON's null is NaN, and its strings may be «Infinity» and «NaN»."""
    try:
        return math.nan if value is None else float(value)
    except TypeError as error:
        what = "an object" if isinstance(value, dict | JsonFields) else strict_json.shown(value)
        raise ValueError(f"{what} is no number") from error


def _text(value: Any) -> str:
    """Return a text; empty where there is none. Raises ValueError."""
    if isinstance(value, _Missing):
        return ""
    if not isinstance(value, str):
        raise ValueError(f"{strict_json.shown(value)} is no text")
    return value


def _octets(value: Any) -> bytes:
    """Return bytes, which JSON has in base64. Raises ValueError."""
    if isinstance(value, _Missing):
        return b""
    if isinstance(value, str):
        return base64.b64decode(value, validate=True)
    if not isinstance(value, bytes):
        raise ValueError(f"{strict_json.shown(value)} are no bytes in base64")
    return value


def _is_json(message: Any) -> bool:
    return isinstance(message, JsonFields)
