"""The log's topics and the codecs of its messages: CDR on one side, prim's own types on the other.

Messages are decoded with :class:`prim.log.cdr.CdrReader`, several times as fast as with a typestore, and without its
start-up. Scans are encoded by a codec of our own, all other messages by rosbags' typestore, which is imported when it
is first needed.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from prim import strict_json
from prim.arrays import FloatArray
from prim.log.cdr import SECOND, CdrReader
from prim.scan import Scan
from prim.se2 import Pose2D
from prim.shapes import Primitive
from prim.world import World

SCAN_TOPIC = "/scan"
ODOM_TOPIC = "/odom"
GPS_TOPIC = "/gps"
COMPASS_TOPIC = "/compass"
TF_TOPIC = "/tf"
TF_STATIC_TOPIC = "/tf_static"
TRUE_POSE_TOPIC = "/ground_truth/pose"
TRUE_PRIMITIVES_TOPIC = "/ground_truth/primitives"

SCAN_TYPE = "sensor_msgs/msg/LaserScan"
ODOMETRY_TYPE = "nav_msgs/msg/Odometry"
POINT_TYPE = "geometry_msgs/msg/PointStamped"
VECTOR_TYPE = "geometry_msgs/msg/Vector3Stamped"
TF_TYPE = "tf2_msgs/msg/TFMessage"
POSE_TYPE = "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE_TYPE = "geometry_msgs/msg/PoseWithCovarianceStamped"
FIX_TYPE = "sensor_msgs/msg/NavSatFix"
MARKERS_TYPE = "visualization_msgs/msg/MarkerArray"

MAP_FRAME = "map"
ODOM_FRAME = "odom"
BASE_FRAME = "base_link"
LASER_FRAME = "laser"

_SCAN_HEAD, _SCAN_GEOMETRY = struct.Struct("<iII"), struct.Struct("<7fI")
"""A LaserScan up to its frame: seconds, nanoseconds, length of the frame; behind it: angles, times, limits, count."""
_LITTLE_ENDIAN = b"\x00\x01\x00\x00"
"""The encapsulation header of plain CDR, little endian."""
_FRAME_AT = len(_LITTLE_ENDIAN) + _SCAN_HEAD.size
"""Where the frame of a message that begins with a header begins (bytes)."""


class StampedPose(NamedTuple):
    """A pose as ROS messages hold it.

    Attributes:
        stamp: Ns.
        frame_id: The frame that the pose is given in.
        child_frame_id: The frame whose pose it is; empty where the message does not say.
        translation: x, y, z (m).
        rotation: Quaternion x, y, z, w as the message holds it: of unit norm only if it is there.
    """

    stamp: int
    frame_id: str
    child_frame_id: str
    translation: tuple[float, float, float]
    rotation: tuple[float, float, float, float]


# LaserScan


def encode_scan(scan: Scan) -> bytes:
    """Encode a scan as sensor_msgs/LaserScan, without intensities."""
    frame = scan.frame_id.encode() + b"\x00"
    head = _SCAN_HEAD.pack(*divmod(scan.stamp, SECOND), len(frame)) + frame
    count = len(scan.ranges)
    geometry = _SCAN_GEOMETRY.pack(
        scan.angle_min,
        scan.angle_min + scan.angle_increment * (count - 1),
        scan.angle_increment,
        scan.time_increment,
        scan.scan_time,
        scan.range_min,
        scan.range_max,
        count,
    )
    padding = b"\x00" * (-len(head) % 4)
    return b"".join(
        (_LITTLE_ENDIAN, head, padding, geometry, scan.ranges.astype("<f4").tobytes(), struct.pack("<I", 0))
    )


def decode_scan(data: bytes) -> Scan:
    """Decode a sensor_msgs/LaserScan of either byte order. Raises ValueError."""
    if data[:2] != b"\0\1":
        return _decode_scan(CdrReader(data))
    try:  # scans are most of a log: the same as _decode_scan in fewer calls
        seconds, nanoseconds, length = _SCAN_HEAD.unpack_from(data, len(_LITTLE_ENDIAN))
        geometry = _FRAME_AT + length + -length % 4
        values = _SCAN_GEOMETRY.unpack_from(data, geometry)
        frame_id = data[_FRAME_AT : _FRAME_AT + length - 1].decode()
        ranges = np.frombuffer(data, "<f4", values[7], geometry + _SCAN_GEOMETRY.size).copy()
    except (struct.error, ValueError):
        return _decode_scan(CdrReader(data))
    stamp = seconds * SECOND + nanoseconds
    return Scan(stamp, frame_id, values[0], values[2], values[5], values[6], ranges, values[3], values[4])


def _decode_scan(cdr: CdrReader) -> Scan:
    stamp, frame_id = cdr.header()
    angle_min, _, angle_increment, time_increment, scan_time, range_min, range_max = cdr.unpack("7f", 4)
    ranges = cdr.floats()
    return Scan(stamp, frame_id, angle_min, angle_increment, range_min, range_max, ranges, time_increment, scan_time)


def decode_stamp(data: bytes) -> int:
    """Decode the stamp (ns) of a message that begins with a header. Raises ValueError."""
    return CdrReader(data).stamp()


# All other messages


@cache
def _typestore() -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def message_definition(type_name: str) -> str:
    """Return the ``ros2msg`` schema of a message type."""
    return str(_typestore().generate_msgdef(type_name, ros_version=2)[0])


def _new(type_name: str, **fields: Any) -> Any:
    return _typestore().types[type_name](**fields)


def _serialize(message: Any) -> bytes:
    return bytes(_typestore().serialize_cdr(message, message.__msgtype__))


def encode_odometry(stamp: int, pose: Pose2D) -> bytes:
    """Encode a pose of ``base_link`` in ``odom``, and its covariance, as nav_msgs/Odometry without velocities.

    Args:
        stamp: Ns.
        pose: The pose.

    Returns:
        The message.
    """
    zero = _new("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    message = _new(
        ODOMETRY_TYPE,
        header=_header(stamp, ODOM_FRAME),
        child_frame_id=BASE_FRAME,
        pose=_new("geometry_msgs/msg/PoseWithCovariance", pose=_pose(pose), covariance=_covariance36(pose)),
        twist=_new(
            "geometry_msgs/msg/TwistWithCovariance",
            twist=_new("geometry_msgs/msg/Twist", linear=zero, angular=zero),
            covariance=np.zeros(36),
        ),
    )
    return _serialize(message)


def encode_pose(stamp: int, pose: Pose2D, frame_id: str = MAP_FRAME) -> bytes:
    """Encode a pose as geometry_msgs/PoseStamped.

    Args:
        stamp: Ns.
        pose: The pose.
        frame_id: The frame that it is given in.

    Returns:
        The message.
    """
    return _serialize(_new(POSE_TYPE, header=_header(stamp, frame_id), pose=_pose(pose)))


def encode_point(stamp: int, x: float, y: float, frame_id: str = MAP_FRAME) -> bytes:
    """Encode a GPS fix as geometry_msgs/PointStamped.

    Args:
        stamp: Ns.
        x: M.
        y: M.
        frame_id: The frame that the point is given in.

    Returns:
        The message.
    """
    return _serialize(_new(POINT_TYPE, header=_header(stamp, frame_id), point=_point(x, y)))


def encode_compass(stamp: int, heading: float) -> bytes:
    """Encode a heading as geometry_msgs/Vector3Stamped: the direction of north (the map's +y) in the robot's frame.

    Args:
        stamp: Ns.
        heading: Of the robot in the map frame (rad).

    Returns:
        The message.
    """
    north = _new("geometry_msgs/msg/Vector3", x=math.sin(heading), y=math.cos(heading), z=0.0)
    return _serialize(_new(VECTOR_TYPE, header=_header(stamp, BASE_FRAME), vector=north))


def encode_transforms(transforms: Iterable[tuple[int, str, str, Pose2D]]) -> bytes:
    """Encode transforms (stamp in ns, parent, child, pose of the child in the parent) as tf2_msgs/TFMessage."""
    return _serialize(_new(TF_TYPE, transforms=[_transform(*transform) for transform in transforms]))


def encode_primitives(stamp: int, world: World) -> bytes:
    """Encode a world as visualization_msgs/MarkerArray: outlines to draw, kind and size as JSON in ``text``.

    Args:
        stamp: Ns.
        world: The world.

    Returns:
        The message.
    """
    markers = [_primitive_marker(stamp, i, primitive) for i, primitive in enumerate(world.primitives)]
    if world.walls:
        markers.append(_walls_marker(stamp, world))
    return _serialize(_new(MARKERS_TYPE, markers=markers))


def decode_primitives(data: bytes) -> tuple[int, tuple[Primitive, ...]]:
    """Invert :func:`encode_primitives`, but for the walls: return stamp (ns; 0 of an empty message) and primitives.

    Raises ValueError.
    """
    cdr = CdrReader(data)
    stamp, primitives = 0, []
    for _ in range(cdr.length(1)):  # a marker has at least one byte
        pose, namespace, text = _read_marker(cdr)
        stamp = pose.stamp
        if namespace == "primitives":
            truth = strict_json.loads(text)
            if not isinstance(truth, dict):
                raise ValueError(f"a marker's text is no object: {text}")
            plane = planar_pose(pose)
            primitive = Primitive.from_json({**truth, "x": plane.x, "y": plane.y, "theta": plane.theta})
            primitives.append(primitive.canonical())
    return stamp, tuple(primitives)


class StampedVector(NamedTuple):
    """A point or vector as ROS messages hold it.

    Attributes:
        stamp: Ns.
        frame_id: The frame that it is given in.
        x: m, or latitude (degrees).
        y: m, or longitude (degrees).
        z: m, or altitude (m).
    """

    stamp: int
    frame_id: str
    x: float
    y: float
    z: float


def decode_vector(data: bytes) -> StampedVector:
    """Decode a geometry_msgs/PointStamped or Vector3Stamped. Raises ValueError."""
    cdr = CdrReader(data)
    return StampedVector(*cdr.header(), *cdr.unpack("3d", 8))


def decode_fix(data: bytes) -> StampedVector:
    """Decode latitude, longitude and altitude of a sensor_msgs/NavSatFix; NaN without a fix. Raises ValueError."""
    cdr = CdrReader(data)
    header = cdr.header()
    status = cdr.unpack("b", 1)[0]
    cdr.unpack("H", 2)
    place = cdr.unpack("3d", 8)
    return StampedVector(*header, *(place if status >= 0 else (math.nan,) * 3))


def decode_poses(type_name: str, data: bytes) -> list[StampedPose]:
    """Decode the poses in a message.

    Args:
        type_name: Its type, one of :data:`POSE_DECODERS`.
        data: The message.

    Returns:
        The poses.

    Raises:
        ValueError: The message is not of that type.
    """
    return POSE_DECODERS[type_name](CdrReader(data))


def planar_pose(pose: StampedPose) -> Pose2D:
    """Project a pose, whose quaternion has unit norm, onto the x-y plane: x, y and the heading of the x axis."""
    x, y, z, w = pose.rotation
    heading = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return Pose2D(pose.translation[0], pose.translation[1], heading)


def _read_pose(cdr: CdrReader, stamp: int, frame_id: str, child_frame_id: str) -> StampedPose:
    """Read a geometry_msgs/Pose or Transform, which have the same fields."""
    x, y, z, qx, qy, qz, qw = cdr.unpack("7d", 8)
    return StampedPose(stamp, frame_id, child_frame_id, (x, y, z), (qx, qy, qz, qw))


def _read_pose_stamped(cdr: CdrReader) -> list[StampedPose]:
    return [_read_pose(cdr, *cdr.header(), "")]


def _read_odometry(cdr: CdrReader) -> list[StampedPose]:
    return [_read_pose(cdr, *cdr.header(), cdr.string())]


def _read_transforms(cdr: CdrReader) -> list[StampedPose]:
    return [_read_pose(cdr, *cdr.header(), cdr.string()) for _ in range(cdr.length(1))]


POSE_DECODERS: dict[str, Callable[[CdrReader], list[StampedPose]]] = {
    ODOMETRY_TYPE: _read_odometry,
    POSE_TYPE: _read_pose_stamped,
    POSE_WITH_COVARIANCE_TYPE: _read_pose_stamped,
    TF_TYPE: _read_transforms,
}
"""The message types that hold poses, and how each is read."""


def _read_marker(cdr: CdrReader) -> tuple[StampedPose, str, str]:
    """Read a visualization_msgs/Marker: its pose, namespace and text."""
    stamp, frame_id = cdr.header()
    namespace = cdr.string()
    cdr.unpack("3i", 4)  # id, type, action
    pose = _read_pose(cdr, stamp, frame_id, "")
    cdr.unpack("3d", 8)  # scale
    cdr.unpack("4f", 4)  # color
    cdr.unpack("iI", 4)  # lifetime
    cdr.unpack("?", 1)  # frame_locked
    cdr.skip(24, 8)  # points
    cdr.skip(16, 4)  # colors
    cdr.string()  # texture_resource
    cdr.header()  # texture: a CompressedImage
    cdr.string()
    cdr.skip(1, 1)
    cdr.skip(8, 4)  # uv_coordinates
    text = cdr.string()
    cdr.string()  # mesh_resource
    cdr.string()  # mesh_file
    cdr.skip(1, 1)
    cdr.unpack("?", 1)  # mesh_use_embedded_materials
    return pose, namespace, text


def _time(stamp: int) -> Any:
    seconds, nanoseconds = divmod(stamp, SECOND)
    return _new("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)


def _header(stamp: int, frame_id: str) -> Any:
    return _new("std_msgs/msg/Header", stamp=_time(stamp), frame_id=frame_id)


def _point(x: float, y: float) -> Any:
    return _new("geometry_msgs/msg/Point", x=float(x), y=float(y), z=0.0)


def _quaternion(theta: float) -> Any:
    half = theta / 2
    return _new("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=math.sin(half), w=math.cos(half))


def _pose(pose: Pose2D) -> Any:
    return _new("geometry_msgs/msg/Pose", position=_point(pose.x, pose.y), orientation=_quaternion(pose.theta))


def _transform(stamp: int, parent: str, child: str, pose: Pose2D) -> Any:
    return _new(
        "geometry_msgs/msg/TransformStamped",
        header=_header(stamp, parent),
        child_frame_id=child,
        transform=_new(
            "geometry_msgs/msg/Transform",
            translation=_new("geometry_msgs/msg/Vector3", x=float(pose.x), y=float(pose.y), z=0.0),
            rotation=_quaternion(pose.theta),
        ),
    )


def _covariance36(pose: Pose2D) -> FloatArray:
    """Return ROS's covariance (36,) of x, y, z, roll, pitch, yaw; zero but for the planar part that is known."""
    covariance = np.zeros((6, 6))
    if pose.covariance is not None:
        covariance[np.ix_((0, 1, 5), (0, 1, 5))] = pose.covariance
    return covariance.ravel()


_LINE_STRIP, _LINE_LIST = 4, 5
"""Marker types of visualization_msgs/Marker."""
_LINE_WIDTH = 0.01
"""m."""
_OUTLINE_POINTS = 64
"""Vertices that are drawn of a curved outline."""
_GREY = (128, 128, 128)
_MAX_CHANNEL = 255


def _primitive_marker(stamp: int, index: int, primitive: Primitive) -> Any:
    outline = primitive.local_outline(_OUTLINE_POINTS)
    text = strict_json.dumps({"kind": str(primitive.kind), "size": primitive.sizes})
    pose = Pose2D(primitive.x, primitive.y, primitive.theta or 0.0)
    color = primitive.kind.row.color
    return _marker(stamp, "primitives", index, _LINE_STRIP, pose, [*outline, outline[0]], text, color)


def _walls_marker(stamp: int, world: World) -> Any:
    ends = np.asarray(world.walls).reshape(-1, 2)
    text = strict_json.dumps({"walls": world.to_json()["walls"]})
    return _marker(stamp, "walls", 0, _LINE_LIST, Pose2D(), list(ends), text, _GREY)


def _marker(
    stamp: int,
    namespace: str,
    index: int,
    shape: int,
    pose: Pose2D,
    points: Sequence[FloatArray],
    text: str,
    color: tuple[int, int, int],
) -> Any:
    red, green, blue = (channel / _MAX_CHANNEL for channel in color)
    return _new(
        "visualization_msgs/msg/Marker",
        header=_header(stamp, MAP_FRAME),
        ns=namespace,
        id=index,
        type=shape,
        action=0,
        pose=_pose(pose),
        scale=_new("geometry_msgs/msg/Vector3", x=_LINE_WIDTH, y=0.0, z=0.0),
        color=_new("std_msgs/msg/ColorRGBA", r=red, g=green, b=blue, a=1.0),
        lifetime=_new("builtin_interfaces/msg/Duration", sec=0, nanosec=0),
        frame_locked=False,
        points=[_point(x, y) for x, y in points],
        colors=[],
        texture_resource="",
        texture=_new("sensor_msgs/msg/CompressedImage", header=_header(0, ""), format="", data=np.zeros(0, np.uint8)),
        uv_coordinates=[],
        text=text,
        mesh_resource="",
        mesh_file=_new("visualization_msgs/msg/MeshFile", filename="", data=np.zeros(0, np.uint8)),
        mesh_use_embedded_materials=False,
    )
