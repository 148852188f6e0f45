"""Messages of strangers: codecs raise ValueError on bytes that are none, and take no more than they are worth."""

import base64
import json
import random
import struct
from typing import Any

import numpy as np
import pytest

from prim.log.decoding.cdr import MAX_ITEMS
from prim.log.decoding.codecs import Codec, codec_of
from prim.log.decoding.foxglove import MAX_JSON_ITEMS, check_field_count
from prim.log.decoding.ros import MAX_PRIMITIVES, MAX_TEXT
from prim.log.decoding.values import MAX_POINTS
from prim.log.messages import MARKERS_TYPE, SCAN_TYPE, TF_TYPE, encode_primitives, encode_scan, encode_transforms
from prim.scan import MAX_BEAMS, Scan
from prim.se2 import Pose2D
from prim.shapes import Kind, Primitive
from prim.world import World

HEAD = b"\0\1\0\0"
HEADER = struct.pack("<iII", 1, 2, 4) + b"map\0"
CLOUD_TYPE, ECHOES_TYPE = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/MultiEchoLaserScan"

SCAN = Scan(5, "laser", -1.0, 0.1, 0.1, 5.0, np.ones(20, dtype=np.float32))
CIRCLE = World((2, 2), (Primitive(next(iter(Kind)), 0.1, 0.2, 0.3, (0.1,)),))

STAMP = {"sec": 1, "nsec": 2}
JSON: dict[str, dict[str, Any]] = {
    "LaserScan": {
        "timestamp": STAMP, "frame_id": "laser", "start_angle": -1.0, "end_angle": 1.0, "ranges": [1.0, 2.0, None],
        "pose": {"position": {"x": 0}, "orientation": {"w": 1}},
    },
    "PointCloud": {
        "timestamp": STAMP, "frame_id": "laser", "point_stride": 8, "data": base64.b64encode(bytes(80)).decode(),
        "fields": [{"name": name, "offset": 4 * k, "type": 7} for k, name in enumerate("xy")],
    },
    "FrameTransforms": {"transforms": [{"timestamp": STAMP, "parent_frame_id": "a", "translation": {"x": 1}}]},
    "FrameTransform": {"timestamp": "2024-01-01T00:00:00Z", "child_frame_id": "b", "rotation": {"w": 1}},
    "PoseInFrame": {"timestamp": STAMP, "frame_id": "map", "pose": {"position": {"x": 0}}},
    "LocationFix": {"timestamp": STAMP, "frame_id": "gps", "latitude": 1, "longitude": 2, "altitude": 3},
}  # fmt: skip


def deep(levels: int) -> list[Any]:
    value: list[Any] = []
    for _ in range(levels):
        value = [value]
    return value


WILD = (
    None, True, -1, 1e308, 10**400, "", "x", "NaN", [], {}, [{}], [[]], [1, {}], {"x": []}, float("inf"),
    float("nan"), deep(300), "9999-12-31T23:59:59+00:00", "0001-01-01T00:00:00+23:00", 5 * 10**9, -(2**63),
    {"sec": float("inf"), "nsec": 0}, {"sec": None, "nsec": None}, {"seconds": "5", "nanos": []},
)  # fmt: skip


def codec(type_name: str, encoding: str = "cdr") -> Codec:
    found = codec_of(type_name, encoding)
    assert found is not None
    return found


def refused(type_name: str, data: bytes, what: str, encoding: str = "cdr") -> None:
    with pytest.raises(ValueError, match=what):
        codec(type_name, encoding).decode(data)


def cloud(height: int, width: int, point_step: int, row_step: int, data: bytes, fields: bytes = b"") -> bytes:
    columns = fields or b"".join(
        struct.pack("<I2sxxIBxxxI", 2, axis + b"\0", offset, 7, 1) for axis, offset in ((b"x", 0), (b"y", 4))
    )
    count = 2 if not fields else 1
    sizes = struct.pack("<III", height, width, count)
    steps = struct.pack("<?xxxIII", False, point_step, row_step, len(data))
    return HEAD + HEADER + sizes + columns + steps + data


def test_a_cloud_is_read_as_it_is_written() -> None:
    points = codec(CLOUD_TYPE).decode(cloud(1, 3, 8, 24, np.arange(6, dtype="<f4").tobytes())).points
    assert points.tolist() == [[0, 1, 0], [2, 3, 0], [4, 5, 0]]


@pytest.mark.parametrize(
    ("sizes", "what"),
    [
        ((1 << 16, 1 << 16, 1 << 16, 0), "points of 65536 bytes"),
        ((2**32 - 1, 2**32 - 1, 8, 2**32 - 1), "points of 8 bytes"),
        ((1, 3, 0, 24), "points of 0 bytes"),
        ((1, 3, 4, 24), "y lies beyond a point's 4 bytes"),
        ((1, 4, 8, 24), "a cloud of 1 x 4 points"),
    ],
)
def test_a_cloud_of_other_sizes_is_refused(sizes: tuple[int, int, int, int], what: str) -> None:
    refused(CLOUD_TYPE, cloud(*sizes, bytes(24)), what)


def test_a_cloud_of_no_points_takes_nothing() -> None:
    assert codec(CLOUD_TYPE).decode(cloud(2**32 - 1, 0, 8, 0, b"")).points.shape == (0, 3)
    assert codec(CLOUD_TYPE).decode(cloud(0, 2**28, 8, 2**31, b"")).points.shape == (0, 3)


def test_a_cloud_of_too_many_points_is_refused() -> None:
    field = struct.pack("<I2sxxIBxxxI", 2, b"x\0", 0, 7, 1)
    refused(CLOUD_TYPE, cloud(1, 3, 8, 24, bytes(24), field), "without x and y")
    count = MAX_POINTS + 1
    both = (field + struct.pack("<I2sxxIBxxxI", 2, b"y\0", 0, 7, 1)).replace(
        struct.pack("<I", 8), struct.pack("<I", 4)
    )
    data = HEAD + HEADER + struct.pack("<III", 1, count, 2) + both
    data += struct.pack("<?xxxIII", False, 4, 4 * count, 4 * count) + bytes(4 * count)
    refused(CLOUD_TYPE, data, f"a cloud of {count} points")


@pytest.mark.parametrize(
    ("type_name", "limit"), [(TF_TYPE, MAX_ITEMS), (MARKERS_TYPE, MAX_PRIMITIVES), (ECHOES_TYPE, MAX_BEAMS)]
)
def test_sequences_of_too_many_items_are_refused_at_once(type_name: str, limit: int) -> None:
    before = HEADER + bytes(28) if type_name == ECHOES_TYPE else b""
    data = HEAD + before + struct.pack("<I", limit + 1) + bytes(4 * limit + 4)
    refused(type_name, data, f"it claims {limit + 1} items, more than {limit}")
    refused(type_name, HEAD + before + struct.pack("<I", 1 << 31), "it claims 2147483648 items")


def test_a_text_of_a_marker_that_is_long_is_not_parsed() -> None:
    data = bytearray(encode_primitives(3, CIRCLE))
    text = b'{"kind"'
    at = data.index(text) - 4
    (length,) = struct.unpack_from("<I", data, at)
    long = b"[" * (MAX_TEXT + 1) + b"\0"
    data[at : at + 4 + length] = struct.pack("<I", len(long)) + long
    with pytest.raises(ValueError, match="a marker's text is no object") as caught:
        codec(MARKERS_TYPE).decode(bytes(data))
    assert len(str(caught.value)) < 200


def test_a_scan_of_too_many_beams_is_none() -> None:
    beams = np.zeros(MAX_BEAMS + 1, dtype=np.float32)
    scan = Scan(0, "laser", -1.0, 1e-6, 0.0, 5.0, beams)
    assert str(MAX_BEAMS) in (scan.problem or "")
    assert str(MAX_BEAMS) not in (Scan(0, "laser", -1.0, 1e-6, 0.0, 5.0, beams[1:]).problem or "")


def test_messages_in_protobuf_and_json_of_too_many_values_are_refused() -> None:
    refused("foxglove.FrameTransforms", b"\x0a\0" * (MAX_ITEMS + 1), f"more than {MAX_ITEMS} fields", "protobuf")
    assert codec("foxglove.FrameTransforms", "protobuf").decode(b"\x0a\0" * 9)
    check_field_count(b"\x0a\xff\xff\xff\xff\x0f" + b"\x09" * 9)
    refused("foxglove.FrameTransforms", b"[" + b"{}," * MAX_JSON_ITEMS + b"]", "values", "json")


def test_data_in_json_are_bytes_in_base64() -> None:
    for value in (5 * 10**9, [1, 2], {"a": 1}, "%%%"):
        message = json.dumps(JSON["PointCloud"] | {"data": value}).encode()
        refused("foxglove.PointCloud", message, r"no bytes in base64|base64|padding", "json")


def test_a_value_that_is_none_is_quoted_in_part() -> None:
    message = json.dumps(JSON["LaserScan"] | {"start_angle": [1] * 9999, "frame_id": deep(300)}).encode()
    with pytest.raises(ValueError, match=r"is no (number|text)|must be") as caught:
        codec("foxglove.LaserScan", "json").decode(message)
    assert len(str(caught.value)) < 300


def flipped(data: bytes, rng: random.Random) -> bytes:
    """Damage bytes: flips, lengths, cuts, holes."""
    changed = bytearray(data)
    for _ in range(rng.randint(1, 3)):
        at = rng.randrange(len(changed))
        kind = rng.randrange(4)
        if kind == 0:
            changed[at] ^= rng.randrange(1, 256)
        elif kind == 1:
            at -= at % 4
            changed[at : at + 4] = struct.pack("<I", rng.choice([0, 1, 255, 2**31 - 1, 2**31, 2**32 - 1]))
        elif kind == 2:
            changed[at : at + rng.randrange(20)] = b""
        else:
            changed[at:at] = changed[at : at + 30] * rng.randrange(4)
        changed = changed or bytearray(1)
    return bytes(changed)


def wild(message: dict[str, Any], rng: random.Random) -> bytes:
    """Put a wild value somewhere into a message in JSON."""
    changed: Any = json.loads(json.dumps(message))
    at = changed
    while True:
        key = rng.choice([*at]) if isinstance(at, dict) else rng.randrange(len(at))
        if isinstance(at[key], dict | list) and at[key] and rng.random() < 0.6:
            at = at[key]
            continue
        at[key] = rng.choice(WILD)
        return json.dumps(changed).encode()


def survives(codec: Codec, data: bytes) -> None:
    """See that a codec raises nothing but ValueError, and that stamps fit into 64 bits."""
    for read in (codec.decode, codec.stamp):
        try:
            value = read(data)
        except ValueError:
            continue
        values = value if isinstance(value, list) else [value]
        assert all(abs(v if isinstance(v, int) else v.stamp) < 2**63 for v in values)


@pytest.mark.parametrize(
    ("type_name", "data"),
    [
        (SCAN_TYPE, encode_scan(SCAN)),
        (ECHOES_TYPE, encode_scan(SCAN)),
        (MARKERS_TYPE, encode_primitives(3, CIRCLE)),
        (TF_TYPE, encode_transforms([(1, "a", "b", Pose2D(1, 2, 3))] * 3)),
        (CLOUD_TYPE, cloud(1, 3, 8, 24, bytes(24))),
    ],
)
@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
def test_damaged_messages_of_ros_raise_value_error(type_name: str, data: bytes, encoding: str) -> None:
    rng = random.Random(0)
    for _ in range(300):
        survives(codec(type_name, encoding), flipped(data, rng))


@pytest.mark.parametrize("name", JSON)
def test_wild_messages_of_foxglove_raise_value_error(name: str) -> None:
    rng = random.Random(0)
    for _ in range(200):
        survives(codec(f"foxglove.{name}", "json"), wild(JSON[name], rng))
        survives(codec(f"foxglove.{name}", "json"), flipped(json.dumps(JSON[name]).encode(), rng))
        survives(codec(f"foxglove.{name}", "protobuf"), rng.randbytes(rng.randrange(40)))
