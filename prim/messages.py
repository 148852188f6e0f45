"""The log's topics and the codecs of its messages: CDR bytes on one side, our own types on the other.

LaserScan has a codec of its own, since it is most of a log; the rest goes through rosbags' typestore, which is
imported when it is first needed.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from prim.frames import Pose2D, Scan
from prim.shapes import FloatArray, Kind, Primitive
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
MARKERS_TYPE = "visualization_msgs/msg/MarkerArray"

MAP_FRAME = "map"
ODOM_FRAME = "odom"
BASE_FRAME = "base_link"
LASER_FRAME = "laser"

KIND_COLORS: dict[Kind, tuple[int, int, int]] = {
    Kind.SQUARE: (86, 180, 233),
    Kind.RECTANGLE: (0, 158, 115),
    Kind.CIRCLE: (230, 159, 0),
    Kind.TRIANGLE: (213, 94, 0),
    Kind.ELLIPSE: (204, 121, 167),
}
"""One colour per kind (RGB), from Okabe and Ito's palette for all kinds of colour vision."""

_LITTLE_ENDIAN = b"\x00\x01\x00\x00"
_SECOND = 1_000_000_000


class StampedPose(NamedTuple):
    """A pose as ROS messages hold it: stamp (ns), both frames, translation (m), quaternion (x, y, z, w)."""

    stamp: int
    frame_id: str
    child_frame_id: str
    translation: tuple[float, float, float]
    rotation: tuple[float, float, float, float]


# LaserScan


def encode_scan(scan: Scan) -> bytes:
    """A scan as the CDR bytes of sensor_msgs/LaserScan, without intensities."""
    frame = scan.frame_id.encode() + b"\x00"
    head = struct.pack("<iII", *divmod(scan.stamp, _SECOND), len(frame)) + frame
    count = len(scan.ranges)
    geometry = struct.pack(
        "<7fI",
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
    """The inverse of :func:`encode_scan`, either byte order. Raises ValueError on bytes that are no LaserScan."""
    order = _byte_order(data)
    try:
        seconds, nanoseconds, length = struct.unpack_from(order + "iII", data, 4)
        geometry = 16 + length + (-length % 4)
        if length > len(data):
            raise ValueError(f"its frame_id claims {length} bytes of {len(data)}")
        frame_id = data[16 : 16 + max(length - 1, 0)].decode()
        values = struct.unpack_from(order + "7fI", data, geometry)
    except (struct.error, UnicodeDecodeError) as error:
        raise ValueError(f"not a LaserScan: {error}") from None
    angle_min, _, angle_increment, time_increment, scan_time, range_min, range_max, count = values
    start = geometry + 32
    if 4 * count > len(data) - start:
        raise ValueError(f"it claims {count} ranges where {max(len(data) - start, 0) // 4} fit")
    return Scan(
        stamp=seconds * _SECOND + nanoseconds,
        frame_id=frame_id,
        angle_min=angle_min,
        angle_increment=angle_increment,
        range_min=range_min,
        range_max=range_max,
        ranges=np.frombuffer(data, order + "f4", count, start).astype(np.float32),
        time_increment=time_increment,
        scan_time=scan_time,
    )


def decode_stamp(data: bytes) -> int:
    """The stamp (ns) of a CDR message that begins with a header. Raises ValueError."""
    try:
        seconds, nanoseconds = struct.unpack_from(_byte_order(data) + "iI", data, 4)
    except struct.error as error:
        raise ValueError(f"no header: {error}") from None
    return int(seconds) * _SECOND + int(nanoseconds)


def _byte_order(data: bytes) -> str:
    if len(data) < 4 or data[0] != 0 or data[1] not in (0, 1):
        raise ValueError("not plain CDR: its encapsulation header is " + (data[:4].hex(" ") or "missing"))
    return "<" if data[1] else ">"


# All other messages


@cache
def _typestore() -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def message_definition(type_name: str) -> str:
    """The ``ros2msg`` schema text of a message type."""
    return str(_typestore().generate_msgdef(type_name, ros_version=2)[0])


def _new(type_name: str, **fields: Any) -> Any:
    return _typestore().types[type_name](**fields)


def _serialize(message: Any) -> bytes:
    return bytes(_typestore().serialize_cdr(message, message.__msgtype__))


def decode_message(type_name: str, data: bytes) -> Any:
    """A message as rosbags decodes it. Raises ValueError on bytes that are no such message."""
    _byte_order(data)
    try:
        return _typestore().deserialize_cdr(data, type_name)
    except Exception as error:  # rosbags raises what its generated code meets: struct, index, unicode errors
        raise ValueError(f"not a {type_name}: {error}") from None


def encode_odometry(stamp: int, pose: Pose2D) -> bytes:
    """A pose of ``base_link`` in ``odom`` with its covariance as nav_msgs/Odometry."""
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
    """A pose as geometry_msgs/PoseStamped."""
    return _serialize(_new(POSE_TYPE, header=_header(stamp, frame_id), pose=_pose(pose)))


def encode_point(stamp: int, x: float, y: float, frame_id: str = MAP_FRAME) -> bytes:
    """A GPS fix in metres as geometry_msgs/PointStamped."""
    return _serialize(_new(POINT_TYPE, header=_header(stamp, frame_id), point=_point(x, y)))


def encode_compass(stamp: int, heading: float) -> bytes:
    """A heading (rad) as the vector that points north in the robot's frame; north is the map's +y."""
    north = _new("geometry_msgs/msg/Vector3", x=math.sin(heading), y=math.cos(heading), z=0.0)
    return _serialize(_new(VECTOR_TYPE, header=_header(stamp, BASE_FRAME), vector=north))


def encode_transforms(transforms: Iterable[tuple[int, str, str, Pose2D]]) -> bytes:
    """(stamp, parent, child, pose of the child in the parent) as tf2_msgs/TFMessage."""
    return _serialize(_new(TF_TYPE, transforms=[_transform(*transform) for transform in transforms]))


def encode_primitives(stamp: int, world: World) -> bytes:
    """A world as visualization_msgs/MarkerArray: outlines to draw, kind and size as JSON in ``text``."""
    markers = [_primitive_marker(stamp, i, primitive) for i, primitive in enumerate(world.primitives)]
    if world.walls:
        markers.append(_walls_marker(stamp, world))
    return _serialize(_new(MARKERS_TYPE, markers=markers))


def decode_primitives(data: bytes) -> tuple[int, tuple[Primitive, ...]]:
    """Stamp (ns) and true primitives of a message of :func:`encode_primitives`; stamp 0 if it is empty.

    Raises ValueError.
    """
    markers = decode_message(MARKERS_TYPE, data).markers
    primitives = []
    for marker in markers:
        if marker.ns == "primitives":
            truth = json.loads(marker.text)
            if not isinstance(truth, dict):
                raise ValueError(f"a marker's text is no object: {marker.text}")
            pose = _stamped(marker.header, "", marker.pose.position, marker.pose.orientation)
            turn = planar(pose)
            primitives.append(
                Primitive.from_json({**truth, "x": turn.x, "y": turn.y, "theta": turn.theta}).canonical()
            )
    stamp = _nanoseconds(markers[0].header.stamp) if markers else 0
    return stamp, tuple(primitives)


def decode_poses(type_name: str, data: bytes) -> list[StampedPose]:
    """The poses in a message of any type in :data:`POSE_DECODERS`. Raises ValueError."""
    return POSE_DECODERS[type_name](decode_message(type_name, data))


def planar(pose: StampedPose) -> Pose2D:
    """The pose seen from above: x, y and the heading of the x axis."""
    x, y, z, w = pose.rotation
    heading = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return Pose2D(pose.translation[0], pose.translation[1], heading)


POSE_DECODERS: dict[str, Callable[[Any], list[StampedPose]]] = {
    ODOMETRY_TYPE: lambda m: [_stamped(m.header, m.child_frame_id, m.pose.pose.position, m.pose.pose.orientation)],
    POSE_TYPE: lambda m: [_stamped(m.header, "", m.pose.position, m.pose.orientation)],
    POSE_WITH_COVARIANCE_TYPE: lambda m: [_stamped(m.header, "", m.pose.pose.position, m.pose.pose.orientation)],
    TF_TYPE: lambda m: [
        _stamped(t.header, t.child_frame_id, t.transform.translation, t.transform.rotation) for t in m.transforms
    ],
}
"""Message types that hold poses, and how to read them."""


def _stamped(header: Any, child: str, position: Any, orientation: Any) -> StampedPose:
    return StampedPose(
        _nanoseconds(header.stamp),
        header.frame_id,
        child,
        (position.x, position.y, position.z),
        (orientation.x, orientation.y, orientation.z, orientation.w),
    )


def _nanoseconds(stamp: Any) -> int:
    return int(stamp.sec) * _SECOND + int(stamp.nanosec)


def _time(stamp: int) -> Any:
    seconds, nanoseconds = divmod(stamp, _SECOND)
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
    """ROS's 6 x 6 covariance (x, y, z, roll, pitch, yaw) from a planar one; zeros where there is none."""
    covariance = np.zeros((6, 6))
    if pose.covariance is not None:
        covariance[np.ix_((0, 1, 5), (0, 1, 5))] = pose.covariance
    return covariance.ravel()


_LINE_STRIP, _LINE_LIST = 4, 5


def _primitive_marker(stamp: int, index: int, primitive: Primitive) -> Any:
    outline = primitive.local_outline(64)
    text = json.dumps({"kind": str(primitive.kind), "size": primitive.sizes})
    pose = Pose2D(primitive.x, primitive.y, primitive.theta or 0.0)
    color = KIND_COLORS[primitive.kind]
    return _marker(stamp, "primitives", index, _LINE_STRIP, pose, [*outline, outline[0]], text, color)


def _walls_marker(stamp: int, world: World) -> Any:
    ends = np.asarray(world.walls).reshape(-1, 2)
    text = json.dumps({"walls": world.to_json()["walls"]})
    return _marker(stamp, "walls", 0, _LINE_LIST, Pose2D(), list(ends), text, (128, 128, 128))


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
    red, green, blue = (channel / 255 for channel in color)
    return _new(
        "visualization_msgs/msg/Marker",
        header=_header(stamp, MAP_FRAME),
        ns=namespace,
        id=index,
        type=shape,
        action=0,
        pose=_pose(pose),
        scale=_new("geometry_msgs/msg/Vector3", x=0.01, y=0.0, z=0.0),
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
