"""What messages decode to, and how: a codec for each type of message in each encoding."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from functools import cache
from typing import Any, NamedTuple

from prim.log.decoding import foxglove, ros
from prim.log.decoding.cdr import CdrReader
from prim.log.decoding.ros1 import Ros1Reader


class Content(StrEnum):
    """What the messages of a topic hold, whatever their type and encoding, and what each decodes to."""

    SCAN = "scans"
    """A :class:`prim.scan.Scan`."""
    CLOUD = "point clouds"
    """A :class:`.values.PointCloud`."""
    TRANSFORMS = "transforms"
    """A list of :class:`.values.StampedPose`, of child_frame_id in frame_id."""
    ODOMETRY = "odometry"
    """A list of one StampedPose of the robot."""
    POSE = "poses"
    """A list of one StampedPose of something."""
    POINT = "points"
    """A :class:`.values.StampedVector` in m."""
    VECTOR = "vectors"
    """A StampedVector."""
    FIX = "satellite fixes"
    """A :class:`.values.StampedFix`."""
    ORIENTATION = "orientations"
    """A :class:`.values.StampedOrientation`."""
    PRIMITIVES = "primitives"
    """A :class:`.values.StampedPrimitives`."""


SCAN_CONTENTS = (Content.SCAN, Content.CLOUD)
"""What scans can be made of."""


class Codec(NamedTuple):
    """How the messages of a topic are decoded.

    Attributes:
        decode: From bytes to what the topic's content decodes to; raises ValueError on others.
        stamp: From bytes to the message's stamp (ns), which is faster than decoding all of it; raises ValueError.
    """

    decode: Callable[[bytes], Any]
    stamp: Callable[[bytes], int]


_ROS: dict[str, tuple[Content, Callable[[CdrReader], Any]]] = {
    "sensor_msgs/msg/LaserScan": (Content.SCAN, ros.read_scan),
    "sensor_msgs/msg/MultiEchoLaserScan": (Content.SCAN, ros.read_echoes),
    "sensor_msgs/msg/PointCloud2": (Content.CLOUD, ros.read_cloud),
    "tf2_msgs/msg/TFMessage": (Content.TRANSFORMS, ros.read_transforms),
    "tf/msg/tfMessage": (Content.TRANSFORMS, ros.read_transforms),
    "nav_msgs/msg/Odometry": (Content.ODOMETRY, ros.read_odometry),
    "geometry_msgs/msg/PoseStamped": (Content.POSE, ros.read_pose_stamped),
    "geometry_msgs/msg/PoseWithCovarianceStamped": (Content.POSE, ros.read_pose_stamped),
    "geometry_msgs/msg/PointStamped": (Content.POINT, ros.read_vector),
    "geometry_msgs/msg/Vector3Stamped": (Content.VECTOR, ros.read_vector),
    "sensor_msgs/msg/NavSatFix": (Content.FIX, ros.read_fix),
    "sensor_msgs/msg/Imu": (Content.ORIENTATION, ros.read_orientation),
    "visualization_msgs/msg/MarkerArray": (Content.PRIMITIVES, ros.read_primitives),
}
"""What the messages of ROS hold, by the names of their types in ROS 2, and how each is read."""

_FOXGLOVE: dict[str, tuple[Content, Callable[[Any], Any]]] = {
    "foxglove.LaserScan": (Content.SCAN, foxglove.read_scan),
    "foxglove.PointCloud": (Content.CLOUD, foxglove.read_cloud),
    "foxglove.FrameTransform": (Content.TRANSFORMS, foxglove.read_transform),
    "foxglove.FrameTransforms": (Content.TRANSFORMS, foxglove.read_transforms),
    "foxglove.PoseInFrame": (Content.POSE, foxglove.read_pose),
    "foxglove.LocationFix": (Content.FIX, foxglove.read_fix),
}
"""What Foxglove's messages hold, and how each is read."""

_SEQUENCES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage", "visualization_msgs/msg/MarkerArray")
"""Messages that begin with the length of a sequence, whose first item has the stamp."""

_ROS_READERS: dict[str, type[CdrReader]] = {"cdr": CdrReader, "ros1": Ros1Reader}
"""The encodings of ROS messages."""

ENCODINGS = (*_ROS_READERS, "protobuf", "json")
"""The encodings that can be read."""


def content_of(type_name: str) -> Content | None:
    """Return what messages of a type hold, by its name in ROS 2 or Foxglove; None where they are of no use here."""
    row = _ROS.get(type_name) or _FOXGLOVE.get(type_name)
    return row[0] if row else None


@cache
def codec_of(type_name: str, encoding: str) -> Codec | None:
    """Return how messages are decoded.

    Args:
        type_name: Their type.
        encoding: How they are serialized.

    Returns:
        The codec; None where such messages cannot be decoded.
    """
    if encoding in _ROS_READERS and type_name in _ROS:
        return _ros_codec(type_name, _ROS_READERS[encoding])
    if encoding == "json" and type_name in _FOXGLOVE:
        return _foxglove_codec(type_name, foxglove.parse_json)
    if encoding == "protobuf" and type_name in _FOXGLOVE:
        return _foxglove_codec(type_name, foxglove.protobuf_parser(type_name.removeprefix("foxglove.")))
    return None


def _ros_codec(type_name: str, reader: type[CdrReader]) -> Codec:
    _, read = _ROS[type_name]

    def decode(data: bytes) -> Any:
        return read(reader(data))

    def stamp(data: bytes) -> int:
        fields = reader(data)
        if type_name in _SEQUENCES and not fields.length(1):
            return 0
        return fields.header_stamp()

    is_plain_scan = reader is CdrReader and read is ros.read_scan
    return Codec(ros.decode_scan if is_plain_scan else decode, stamp)


def _foxglove_codec(type_name: str, parse: Callable[[bytes], Any]) -> Codec:
    _, read = _FOXGLOVE[type_name]
    read_stamp = foxglove.first_stamp if type_name.endswith("FrameTransforms") else foxglove.read_stamp

    def decode(data: bytes) -> Any:
        try:
            return read(parse(data))
        except (AttributeError, TypeError, OverflowError) as error:  # a field of JSON is of another kind
            raise ValueError(f"no {type_name}: {error}") from error

    def stamp(data: bytes) -> int:
        try:
            return read_stamp(parse(data))
        except (AttributeError, TypeError, OverflowError) as error:
            raise ValueError(f"no {type_name}: {error}") from error

    return Codec(decode, stamp)
