"""The topics of a recorded log, and its messages: from prim's own types to CDR (prim.log.decoding reads it).

Scans are encoded by a codec of our own, all other messages by rosbags' typestore, which is imported when it is first
needed.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Sequence
from functools import cache
from typing import Any

import numpy as np

from prim import strict_json
from prim.arrays import FloatArray
from prim.log.decoding.cdr import SECOND
from prim.log.decoding.ros import SCAN_GEOMETRY, SCAN_HEAD
from prim.scan import Scan
from prim.se2 import Pose2D
from prim.shapes import Primitive
from prim.world import Solid, World

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
MARKERS_TYPE = "visualization_msgs/msg/MarkerArray"

MAP_FRAME = "map"
ODOM_FRAME = "odom"
BASE_FRAME = "base_link"
LASER_FRAME = "laser"

_LITTLE_ENDIAN = b"\x00\x01\x00\x00"
"""The encapsulation header of plain CDR, little endian."""


def encode_scan(scan: Scan) -> bytes:
    """Encode a scan as sensor_msgs/LaserScan, without intensities."""
    frame = scan.frame_id.encode() + b"\x00"
    head = SCAN_HEAD.pack(*divmod(scan.stamp, SECOND), len(frame)) + frame
    count = len(scan.ranges)
    geometry = SCAN_GEOMETRY.pack(
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

    Primitives are of the namespace «primitives», one marker each. Walls, clutter and structure have one marker each
    for all of them, in namespaces of their own.

    Args:
        stamp: Ns.
        world: The world.

    Returns:
        The message.
    """
    markers = [_primitive_marker(stamp, i, primitive) for i, primitive in enumerate(world.primitives)]
    if world.walls:
        markers.append(_walls_marker(stamp, world))
    for namespace, solids in (("clutter", world.clutter), ("structure", world.structure)):
        if solids:
            markers.append(_solids_marker(stamp, namespace, solids))
    return _serialize(_new(MARKERS_TYPE, markers=markers))


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
_LIGHT_GREY = (190, 190, 190)
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


def _solids_marker(stamp: int, namespace: str, solids: Sequence[Solid]) -> Any:
    ends = np.vstack([solid.as_segments() for solid in solids]).reshape(-1, 2)
    text = strict_json.dumps({namespace: [solid.to_json() for solid in solids]})
    return _marker(stamp, namespace, 0, _LINE_LIST, Pose2D(), list(ends), text, _LIGHT_GREY)


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
