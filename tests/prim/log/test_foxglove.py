"""Foxglove's messages in JSON: fields that are missing, null, or of other kinds; times in all their forms."""

import base64
import json
import math
from typing import Any

import numpy as np
import pytest

from prim.log.decoding.cdr import SECOND
from prim.log.decoding.codecs import codec_of
from prim.log.decoding.values import PointCloud
from prim.scan import Scan

STAMP = 1_700_000_000 * SECOND + 250_000_000
SCAN = {"timestamp": {"sec": STAMP // SECOND, "nsec": STAMP % SECOND}, "frame_id": "laser", "ranges": [1, 2.5, 3]}
SCAN |= {"start_angle": -1, "end_angle": 1, "pose": {"orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}}
CLOUD = {
    "timestamp": SCAN["timestamp"],
    "point_stride": 8,
    "fields": [{"name": "x", "offset": 0, "type": 7}, {"name": "y", "offset": 4, "type": 7}],
    "data": base64.b64encode(np.array([[1, 2], [3, 4]], "<f4").tobytes()).decode(),
}
TURNED = {
    "position": {"x": 0, "y": 0, "z": 0},
    "orientation": {"x": 0, "y": 0, "z": math.sqrt(0.5), "w": math.sqrt(0.5)},
}


def decoded(kind: str, values: dict[str, Any]) -> Any:
    codec = codec_of(f"foxglove.{kind}", "json")
    assert codec is not None
    data = json.dumps(values).encode()
    value = codec.decode(data)
    assert codec.stamp(data) == value.stamp
    return value


def scan(without: str = "", **others: Any) -> Scan:
    values = {name: value for name, value in (SCAN | others).items() if name != without}
    found: Scan = decoded("LaserScan", values)
    return found


@pytest.mark.parametrize(
    "timestamp",
    [
        {"sec": STAMP // SECOND, "nsec": STAMP % SECOND},
        {"sec": STAMP // SECOND, "nanosec": STAMP % SECOND},
        {"seconds": STAMP // SECOND, "nanos": STAMP % SECOND},
        {"seconds": str(STAMP // SECOND), "nanos": STAMP % SECOND},
        "2023-11-14T22:13:20.25Z",
        "2023-11-14T22:13:20.250000000Z",
        "2023-11-14T23:13:20.250+01:00",
        "2023-11-14T22:13:20.25",
    ],
)
def test_times_are_read_in_all_their_forms(timestamp: Any) -> None:
    assert abs(scan(timestamp=timestamp).stamp - STAMP) < 1000


@pytest.mark.parametrize("timestamp", [1.7e9, "yesterday", {}, {"sec": 1}, [1, 2], {"sec": 1e300, "nsec": 0}])
def test_other_times_are_refused(timestamp: Any) -> None:
    with pytest.raises(ValueError, match=r".+"):
        scan(timestamp=timestamp)


def test_a_time_that_is_not_there_is_0() -> None:
    assert scan(without="timestamp").stamp == scan(timestamp=None).stamp == 0


def test_null_stands_for_what_is_not_there() -> None:
    assert scan(frame_id=None).frame_id == scan(without="frame_id").frame_id == ""
    assert scan(pose=None).angle_min == scan(without="pose").angle_min == -1
    assert scan(ranges=[None, "Infinity", "NaN", 1]).ranges.tolist()[1:2] == [math.inf]
    assert np.isnan(scan(ranges=[None, "Infinity", "NaN", 1]).ranges).tolist() == [True, False, True, False]


@pytest.mark.parametrize("name", ["start_angle", "end_angle", "ranges"])
def test_a_scan_must_have_its_angles_and_ranges(name: str) -> None:
    with pytest.raises(ValueError, match=f"a scan without {name}"):
        scan(without=name)


def test_a_null_angle_makes_a_scan_unusable() -> None:
    assert scan(start_angle=None).problem is not None


@pytest.mark.parametrize("ranges", ["abc", [[1], [2]], [{"a": 1}], ["abc"]])
def test_ranges_that_are_no_numbers_are_refused(ranges: Any) -> None:
    with pytest.raises(ValueError, match=r"number|float") as error:
        scan(ranges=ranges)
    assert " at 0x" not in str(error.value)


def cloud(**others: Any) -> PointCloud:
    found: PointCloud = decoded("PointCloud", CLOUD | others)
    return found


def test_a_cloud_is_turned_by_its_pose() -> None:
    assert cloud().points[:, :2].tolist() == [[1, 2], [3, 4]]
    assert cloud(pose=TURNED).points[:, :2] == pytest.approx(np.array([[-2, 1], [-4, 3]]))
    with pytest.raises(ValueError, match="moves the laser"):
        cloud(pose=TURNED | {"position": {"x": 1, "y": 0, "z": 0}})


def test_types_of_fields_may_be_named() -> None:
    fields = [{"name": name, "offset": 4 * k, "type": "FLOAT32"} for k, name in enumerate("xy")]
    assert np.array_equal(cloud(fields=fields).points, cloud().points)


@pytest.mark.parametrize(
    "others",
    [
        {"data": "@@@"},
        {"point_stride": 0},
        {"fields": [{"name": name, "offset": -4, "type": 7} for name in "xy"]},
        {"fields": [{"name": name, "offset": 0, "type": "TEXT"} for name in "xy"]},
        {"fields": []},
    ],
)
def test_a_cloud_that_does_not_fit_together_is_refused(others: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"cloud|base64"):
        cloud(**others)
