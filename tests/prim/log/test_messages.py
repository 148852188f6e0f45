import json
import math
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from rosbags.typesys import Stores, get_typestore

from prim.log.decoding.codecs import codec_of
from prim.log.decoding.ros import decode_scan
from prim.log.decoding.values import planar_pose
from prim.log.messages import (
    MARKERS_TYPE,
    ODOMETRY_TYPE,
    POSE_TYPE,
    SCAN_TYPE,
    TF_TYPE,
    encode_compass,
    encode_odometry,
    encode_pose,
    encode_primitives,
    encode_scan,
    encode_transforms,
)
from prim.scan import Scan
from prim.se2 import Pose2D
from prim.shapes import Kind, Primitive
from prim.world import Solid, World

STORE = get_typestore(Stores.ROS2_JAZZY)
FLOATS = st.floats(0, 100, width=32)
SCANS = st.builds(
    Scan,
    stamp=st.integers(0, 2**31 * 10**9 - 1),
    frame_id=st.text(st.characters(exclude_characters="\x00", exclude_categories=["Cs"]), max_size=9),
    angle_min=FLOATS,
    angle_increment=FLOATS,
    range_min=FLOATS,
    range_max=FLOATS,
    ranges=hnp.arrays(np.float32, st.integers(0, 20), elements=st.floats(width=32)),
    time_increment=FLOATS,
    scan_time=FLOATS,
)


def decode(type_name: str, data: bytes) -> Any:
    codec = codec_of(type_name, "cdr")
    assert codec is not None
    return codec.decode(data)


def decode_stamp(data: bytes, type_name: str = SCAN_TYPE) -> int:
    codec = codec_of(type_name, "cdr")
    assert codec is not None
    return codec.stamp(data)


def same(a: Scan, b: Scan) -> bool:
    fields = ("stamp", "frame_id", "angle_min", "angle_increment", "range_min", "range_max", "scan_time")
    return all(getattr(a, f) == getattr(b, f) for f in fields) and np.array_equal(a.ranges, b.ranges, equal_nan=True)


@given(SCANS)
def test_scans_round_trip(scan: Scan) -> None:
    assert same(decode_scan(encode_scan(scan)), scan)
    assert decode_stamp(encode_scan(scan)) == scan.stamp


@given(SCANS)
def test_rosbags_decodes_encoded_scans(scan: Scan) -> None:
    theirs = STORE.deserialize_cdr(encode_scan(scan), SCAN_TYPE)
    assert theirs.header.frame_id == scan.frame_id
    assert np.array_equal(theirs.ranges, scan.ranges, equal_nan=True)
    assert (theirs.range_min, theirs.range_max) == (scan.range_min, scan.range_max)
    for little in (True, False):
        assert same(decode_scan(bytes(STORE.serialize_cdr(theirs, SCAN_TYPE, little_endian=little))), scan)


@given(SCANS, st.data())
def test_truncated_scans_are_refused(scan: Scan, data: st.DataObject) -> None:
    whole = encode_scan(scan)
    cut = data.draw(st.integers(0, len(whole) - 5))  # the last four bytes count the intensities, which are not read
    with pytest.raises(ValueError, match=r"CDR|ends at byte|claims"):
        decode_scan(whole[:cut])


@pytest.mark.parametrize("claimed", [1000, 2**31, 2**32 - 1])
def test_a_count_beyond_the_end_is_refused(claimed: int) -> None:
    scan = Scan(0, "laser", 0.0, 0.1, 0.1, 5.0, np.ones(4, dtype=np.float32))
    whole = bytearray(encode_scan(scan))
    at = whole.index(struct.pack("<I", 4), 40)
    whole[at : at + 4] = struct.pack("<I", claimed)
    with pytest.raises(ValueError, match=f"claims {claimed} items"):
        decode_scan(bytes(whole))


@pytest.mark.parametrize("theta", [0.0, 1.0, -3.1, math.pi])
def test_poses_round_trip(theta: float) -> None:
    pose = Pose2D(1.5, -2.5, theta, np.diag([1.0, 2.0, 3.0]))
    stamp = 1_735_689_600_123_456_789
    for type_name, data in (
        (ODOMETRY_TYPE, encode_odometry(stamp, pose)),
        (POSE_TYPE, encode_pose(stamp, pose)),
        (TF_TYPE, encode_transforms([(stamp, "odom", "base_link", pose)])),
    ):
        (stamped,) = decode(type_name, data)
        seen = planar_pose(stamped)
        assert stamped.stamp == stamp
        assert (seen.x, seen.y) == (1.5, -2.5)
        assert math.cos(seen.theta - theta) == pytest.approx(1)


def test_odometry_holds_the_covariance() -> None:
    pose = Pose2D(0, 0, 0, np.arange(9.0).reshape(3, 3))
    matrix = STORE.deserialize_cdr(encode_odometry(0, pose), ODOMETRY_TYPE).pose.covariance.reshape(6, 6)
    assert matrix[np.ix_((0, 1, 5), (0, 1, 5))].tolist() == pose.covariance.tolist()
    assert matrix.sum() == pose.covariance.sum()


def test_compass_points_north() -> None:
    """A robot that faces east (x) has north (y) at its left; one that faces north has it ahead."""
    for heading, expected in ((0.0, (0, 1)), (math.pi / 2, (1, 0))):
        north = STORE.deserialize_cdr(encode_compass(0, heading), "geometry_msgs/msg/Vector3Stamped").vector
        assert (north.x, north.y) == pytest.approx(expected, abs=1e-12)


def test_primitives_round_trip() -> None:
    shapes = (
        Primitive(Kind.CIRCLE, 0.1, 0.2, None, (0.1,)),
        Primitive(Kind.TRIANGLE, -0.1, 0.2, 5.0, (0.1, 0.2)),
        Primitive(Kind.ELLIPSE, -0.5, 0.2, 2.0, (0.2, 0.1)),
    )
    stamp, primitives = decode(MARKERS_TYPE, encode_primitives(7, World((2, 2), shapes).with_walls()))
    assert stamp == 7
    for primitive, shape in zip(primitives, shapes, strict=True):
        assert primitive.kind is shape.kind
        assert primitive.size == shape.size
        assert (primitive.x, primitive.y, primitive.theta or 0) == pytest.approx((shape.x, shape.y, shape.theta or 0))


def test_clutter_and_structure_are_markers_but_no_primitives() -> None:
    things = [Solid.of(name, np.array([(0, 0), (1, 0), (0.2, 0.3)]) + 2 * k) for k, name in enumerate("abc")]
    world = World((9, 9), (Primitive(Kind.CIRCLE, 0.1, 0.2, None, (0.1,)),), (), (things[0],), tuple(things[1:]))
    data = encode_primitives(7, world)
    assert len(decode(MARKERS_TYPE, data)[1]) == 1
    markers = {marker.ns: marker for marker in STORE.deserialize_cdr(data, MARKERS_TYPE).markers}
    assert markers.keys() == {"primitives", "clutter", "structure"}
    assert json.loads(markers["clutter"].text) == {"clutter": [things[0].to_json()]}
    assert json.loads(markers["structure"].text) == {"structure": [thing.to_json() for thing in things[1:]]}
    points = np.array([(point.x, point.y) for point in markers["structure"].points]).reshape(-1, 4)
    assert np.array_equal(points, np.vstack([thing.as_segments() for thing in things[1:]]))


@pytest.mark.parametrize(
    "data", [b"", b"\x00", b"\x00\x01\x00\x00", b"\xff" * 40, b"\x00\x01\x00\x00" + b"\xff" * 40]
)
def test_other_bytes_are_refused(data: bytes) -> None:
    for type_name in (SCAN_TYPE, MARKERS_TYPE, TF_TYPE):
        with pytest.raises(ValueError, match=r"not|CDR|claims|ends at byte"):
            decode(type_name, data)
