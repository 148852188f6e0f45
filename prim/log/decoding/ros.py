"""The messages of ROS: from CDR or ROS 1's serialization to prim's own types.

They are read field by field, several times as fast as with a typestore, and without its start-up. The readers here
raise ValueError where the bytes are no such message.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from prim import strict_json
from prim.arrays import FloatArray
from prim.log.decoding.cdr import SECOND, CdrError, CdrReader
from prim.log.decoding.ros1 import Ros1Reader
from prim.log.decoding.values import (
    PointCloud,
    StampedFix,
    StampedOrientation,
    StampedPose,
    StampedPrimitives,
    StampedVector,
    checked_count,
    planar_pose,
    plane_variance,
)
from prim.scan import MAX_BEAMS, Scan
from prim.shapes import Primitive

SCAN_HEAD, SCAN_GEOMETRY = struct.Struct("<iII"), struct.Struct("<7fI")
"""A LaserScan up to its frame: seconds, nanoseconds, length of the frame; behind it: angles, times, limits, count."""
_FRAME_AT = 4 + SCAN_HEAD.size
"""Where the frame of a message in CDR that begins with a header begins (bytes)."""

MAX_PRIMITIVES = 10_000
"""A world has no more primitives; set by hand."""

MAX_TEXT = 1 << 12
"""What a marker says of its primitive, kind and size, is no longer (characters)."""

FLOAT_TYPES = {7: "f4", 8: "f8"}
"""The codes of sensor_msgs/PointField for numbers of floating point, and what they mean to NumPy."""


def decode_scan(data: bytes) -> Scan:
    """Decode a sensor_msgs/LaserScan in CDR of either byte order. Raises ValueError."""
    if data[:2] != b"\0\1":
        return read_scan(CdrReader(data))
    try:  # scans are most of a log: the same as read_scan in fewer calls
        seconds, nanoseconds, length = SCAN_HEAD.unpack_from(data, 4)
        geometry = _FRAME_AT + length + -length % 4
        first, last, increment, time_increment, scan_time, shortest, longest, count = SCAN_GEOMETRY.unpack_from(
            data, geometry
        )
        frame_id = data[_FRAME_AT : _FRAME_AT + length - 1].decode()
        ranges = np.frombuffer(data, "<f4", count, geometry + SCAN_GEOMETRY.size).copy()
    except (struct.error, ValueError):
        return read_scan(CdrReader(data))
    stamp = seconds * SECOND + nanoseconds
    return Scan(stamp, frame_id, first, increment, shortest, longest, ranges, time_increment, scan_time, 0, last)


def read_scan(fields: CdrReader) -> Scan:
    """Read a sensor_msgs/LaserScan."""
    return _read_scan(fields, CdrReader.floats)


def read_echoes(fields: CdrReader) -> Scan:
    """Read a sensor_msgs/MultiEchoLaserScan: each beam's first echo; NaN of a beam without any."""
    return _read_scan(fields, _first_echoes)


def _read_scan(fields: CdrReader, read_ranges: Callable[[CdrReader], NDArray[np.float32]]) -> Scan:
    stamp, frame_id = fields.header()
    first, last, increment, time_increment, scan_time, shortest, longest = fields.unpack("7f", 4)
    ranges = read_ranges(fields)
    return Scan(stamp, frame_id, first, increment, shortest, longest, ranges, time_increment, scan_time, 0, last)


def _first_echoes(fields: CdrReader) -> NDArray[np.float32]:
    first = []
    for _ in fields.items(MAX_BEAMS):
        echoes = fields.floats()
        first.append(echoes[0] if len(echoes) else math.nan)
    return np.array(first, dtype=np.float32)


def read_cloud(fields: CdrReader) -> PointCloud:
    """Read a sensor_msgs/PointCloud2 that has x, y and, unless it is flat, z."""
    stamp, frame_id = fields.header()
    height, width = (int(size) for size in fields.unpack("II", 4))
    columns: dict[str, tuple[int, int]] = {}
    for _ in fields.items():
        name = fields.string()
        offset = int(fields.unpack("I", 4)[0])
        kind = int(fields.unpack("B", 1)[0])
        fields.unpack("I", 4)
        columns[name] = offset, kind
    big_endian = bool(fields.unpack("?", 1)[0])
    point_step, row_step = (int(step) for step in fields.unpack("II", 4))
    data = fields.octets()
    order = ">" if big_endian else "<"
    if len({"x", "y"} & columns.keys()) < 2 or any(kind not in FLOAT_TYPES for _, kind in _axes(columns).values()):
        raise CdrError("a cloud without x and y of floating point")
    if point_step < 1 or row_step < width * point_step or len(data) < height * row_step:
        raise CdrError(f"a cloud of {height} x {width} points of {point_step} bytes in {len(data)} bytes")
    return PointCloud(stamp, frame_id, _points(columns, order, height, width, point_step, row_step, data))


def _axes(columns: dict[str, tuple[int, int]]) -> dict[str, tuple[int, int]]:
    return {axis: columns[axis] for axis in "xyz" if axis in columns}


def _points(
    columns: dict[str, tuple[int, int]],
    order: str,
    height: int,
    width: int,
    point_step: int,
    row_step: int,
    data: bytes,
) -> FloatArray:
    """Return the points (N, 3) of a cloud's bytes; z is 0 where there is none."""
    checked_count(height * width)
    points = np.zeros((height, width, 3))
    for k, axis in enumerate("xyz"):
        if axis not in columns:
            continue
        offset, kind = columns[axis]
        if offset + np.dtype(FLOAT_TYPES[kind]).itemsize > point_step:
            raise CdrError(f"{axis} lies beyond a point's {point_step} bytes")
        if height and width:
            points[..., k] = np.ndarray(
                (height, width), order + FLOAT_TYPES[kind], data, offset, (row_step, point_step)
            )
    return points.reshape(-1, 3)


def read_vector(fields: CdrReader) -> StampedVector:
    """Read a geometry_msgs/PointStamped or Vector3Stamped."""
    return StampedVector(*fields.header(), *fields.unpack("3d", 8))


def read_fix(fields: CdrReader) -> StampedFix:
    """Read latitude, longitude, altitude and their variance in the plane of a sensor_msgs/NavSatFix."""
    stamp, frame_id = fields.header()
    status = fields.unpack("b", 1)[0]
    fields.unpack("H", 2)
    latitude, longitude, altitude = fields.unpack("3d", 8)
    if status < 0:
        latitude = longitude = altitude = math.nan
    covariance = fields.unpack("9d", 8)
    variance = plane_variance(covariance, fields.unpack("B", 1)[0] > 0)
    return StampedFix(stamp, frame_id, latitude, longitude, altitude, variance)


def read_orientation(fields: CdrReader) -> StampedOrientation:
    """Read the orientation of a sensor_msgs/Imu, which has none where its covariance begins with -1."""
    header = fields.header()
    x, y, z, w = fields.unpack("4d", 8)
    return StampedOrientation(*header, (x, y, z, w) if fields.unpack("9d", 8)[0] != -1 else None)


def read_pose_stamped(fields: CdrReader) -> list[StampedPose]:
    """Read a geometry_msgs/PoseStamped or PoseWithCovarianceStamped."""
    return [_read_pose(fields, *fields.header(), "")]


def read_odometry(fields: CdrReader) -> list[StampedPose]:
    """Read the pose of a nav_msgs/Odometry."""
    return [_read_pose(fields, *fields.header(), fields.string())]


def read_transforms(fields: CdrReader) -> list[StampedPose]:
    """Read a tf2_msgs/TFMessage."""
    return [_read_pose(fields, *fields.header(), fields.string()) for _ in fields.items()]


def _read_pose(fields: CdrReader, stamp: int, frame_id: str, child_frame_id: str) -> StampedPose:
    """Read a geometry_msgs/Pose or Transform, which have the same fields."""
    x, y, z, qx, qy, qz, qw = fields.unpack("7d", 8)
    return StampedPose(stamp, frame_id, child_frame_id, (x, y, z), (qx, qy, qz, qw))


def read_primitives(fields: CdrReader) -> StampedPrimitives:
    """Invert :func:`prim.log.messages.encode_primitives`, but for the walls."""
    stamp, primitives = 0, []
    for _ in fields.items(MAX_PRIMITIVES):
        pose, namespace, text = _read_marker(fields)
        stamp = pose.stamp
        if namespace == "primitives":
            truth = strict_json.loads(text) if len(text) <= MAX_TEXT else None
            if not isinstance(truth, dict):
                raise ValueError(f"a marker's text is no object: {strict_json.shown(text)}")
            plane = planar_pose(pose)
            primitive = Primitive.from_json({**truth, "x": plane.x, "y": plane.y, "theta": plane.theta})
            primitives.append(primitive.canonical())
    return StampedPrimitives(stamp, tuple(primitives))


def _read_marker(fields: CdrReader) -> tuple[StampedPose, str, str]:
    """Read a visualization_msgs/Marker: its pose, namespace and text."""
    stamp, frame_id = fields.header()
    namespace = fields.string()
    fields.unpack("3i", 4)  # id, type, action
    pose = _read_pose(fields, stamp, frame_id, "")
    fields.unpack("3d", 8)  # scale
    fields.unpack("4f", 4)  # color
    fields.unpack("iI", 4)  # lifetime
    fields.unpack("?", 1)  # frame_locked
    fields.skip(24, 8)  # points
    fields.skip(16, 4)  # colors
    textured = not isinstance(fields, Ros1Reader)
    if textured:
        fields.string()  # texture_resource
        fields.header()  # texture: a CompressedImage
        fields.string()
        fields.skip(1, 1)
        fields.skip(8, 4)  # uv_coordinates
    text = fields.string()
    fields.string()  # mesh_resource
    if textured:
        fields.string()  # mesh_file
        fields.skip(1, 1)
    fields.unpack("?", 1)  # mesh_use_embedded_materials
    return pose, namespace, text
