"""CARMEN's text logs: FLASER, RLASER or ROBOTLASER1 for scans, ODOM for odometry.

Lost: all but scans and odometry; ranges are in whole centimetres, what is not finite becomes the maximum range (no
return) or 0 (no measurement, or too near); poses have six decimals and no covariance; times have microseconds; there
is no ``range_min``; FLASER and RLASER know no angles but 180 degrees.
"""

from __future__ import annotations

import gzip
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from prim.log.decoding.cdr import SECOND
from prim.log.decoding.ros import decode_scan
from prim.log.decoding.values import planar_pose
from prim.log.messages import (
    ODOM_TOPIC,
    ODOMETRY_TYPE,
    SCAN_TOPIC,
    SCAN_TYPE,
    TF_STATIC_TOPIC,
    TF_TYPE,
    encode_odometry,
    encode_scan,
)
from prim.log.source import Message
from prim.scan import Scan
from prim.se2 import Pose2D
from tests.encodings.content import LogContent, decode_poses, mapped

ROS_TYPES = {TF_STATIC_TOPIC: TF_TYPE, ODOM_TOPIC: ODOMETRY_TYPE, SCAN_TOPIC: SCAN_TYPE}
"""The topics that are written; the fixed transform to the laser becomes the poses of the lines of scans."""
DECIMALS, RANGE_DECIMALS = 6, 2
HALF_TURN_TOLERANCE = 1e-5
"""Of a scanner's angles from those of FLASER (rad)."""


@dataclass(frozen=True)
class _Line:
    """What a line of a scan is made of."""

    scan: Scan
    laser: Pose2D
    robot: Pose2D


def write_flaser(content: LogContent, folder: Path) -> Path:
    return _write(content, folder, lambda line: _laser_line("FLASER", line))


def write_flaser_gz(content: LogContent, folder: Path) -> Path:
    path = folder / "log.log.gz"
    path.write_bytes(gzip.compress(write_flaser(content, folder).read_bytes()))
    return path


def write_rlaser(content: LogContent, folder: Path) -> Path:
    return _write(content, folder, lambda line: _laser_line("RLASER", line))


def write_robotlaser(content: LogContent, folder: Path) -> Path:
    return _write(content, folder, _robotlaser_line)


def reduce_to_carmen(content: LogContent) -> LogContent:
    """Reduce a session to what is written, but for the digits of the laser's place on the robot."""
    reduced = mapped(content, ROS_TYPES, _reduced)
    stamped = (m._replace(log_time=_stamp(m)) for m in reduced.messages)
    return replace(reduced, messages=tuple(stamped))


def increment(beams: int) -> float:
    """Return FLASER's angle from beam to beam (rad): 180 degrees have both ends where the number of beams is odd."""
    return math.pi / (beams - beams % 2)


def mount(content: LogContent) -> Pose2D:
    """Return the laser's pose on the robot."""
    return planar_pose(decode_poses(TF_TYPE, content.of(TF_STATIC_TOPIC)[0].data)[0])


def _write(content: LogContent, folder: Path, scan_line: Callable[[_Line], str]) -> Path:
    lines = ["# CARMEN Logfile"]
    start, robot = min(map(_stamp, content.messages)), Pose2D()
    on_robot = mount(content)
    longest = decode_scan(content.of(SCAN_TOPIC)[0].data).range_max
    for side in ("front", "rear"):
        for name, value in ((f"robot_{side}_laser_max", longest), (f"robot_{side}laser_offset", on_robot.x)):
            lines.append(f"PARAM {name} {_digits(value)} {_end(start, start)}")
    for message in content.messages:
        stamp = _stamp(message)
        if message.topic == ODOM_TOPIC:
            robot = _odometry(message)
            lines.append(f"ODOM {_digits(*_values(robot))} {_digits(0.0, 0.0, 0.0)} {_end(stamp, start)}")
        elif message.topic == SCAN_TOPIC:
            line = _Line(decode_scan(message.data), robot @ on_robot, robot)
            lines.append(f"{scan_line(line)} {_end(stamp, start)}")
    path = folder / "log.log"
    path.write_text("\n".join(lines) + "\n", encoding="ascii")
    return path


def _laser_line(name: str, line: _Line) -> str:
    scan, count = line.scan, len(line.scan.ranges)
    wrong = abs(scan.angle_min + math.pi / 2), count * abs(scan.angle_increment - increment(count))
    if max(wrong) > HALF_TURN_TOLERANCE:
        raise ValueError(f"{name} knows no such angles: {scan.angle_min} rad, {scan.angle_increment} rad a beam")
    poses = _digits(*_values(line.laser), *_values(line.robot))
    return f"{name} {count} {_ranges(scan)} {poses}"


def _robotlaser_line(line: _Line) -> str:
    scan, count = line.scan, len(line.scan.ranges)
    view = scan.angle_increment * (count - 1)
    head = f"0 {scan.angle_min:.9g} {view:.12g} {scan.angle_increment:.9g} {scan.range_max:.{DECIMALS}f} 0.01 0"
    poses = _digits(*_values(line.laser), *_values(line.robot))
    motion_and_safety = _digits(0.0, 0.0, 0.4, 0.3, 1e6)
    return f"ROBOTLASER1 {head} {count} {_ranges(scan)} 0 {poses} {motion_and_safety}"


def _end(stamp: int, start: int) -> str:
    """Return what ends each line: time, host, and the time since the log's start."""
    seconds, nanoseconds = divmod(stamp, SECOND)
    return f"{seconds}.{nanoseconds // 1000:06d} robot {(stamp - start) / SECOND:.{DECIMALS}f}"


def _digits(*values: float) -> str:
    return " ".join(f"{value:.{DECIMALS}f}" for value in values)


def _values(pose: Pose2D) -> tuple[float, float, float]:
    return pose.x, pose.y, pose.theta


def _ranges(scan: Scan) -> str:
    return " ".join(f"{z:.{RANGE_DECIMALS}f}" for z in _finite_ranges(scan))


def _finite_ranges(scan: Scan) -> list[float]:
    """Return the ranges as a scanner gives them that knows neither infinity nor NaN."""
    ranges = np.where(scan.ranges == np.inf, scan.range_max, scan.ranges.astype(float))
    return np.where(np.isfinite(ranges), ranges, 0.0).tolist()


def _odometry(message: Message) -> Pose2D:
    return planar_pose(decode_poses(ODOMETRY_TYPE, message.data)[0])


def _stamp(message: Message) -> int:
    """Return a message's stamp, in whole microseconds (ns)."""
    if message.topic == SCAN_TOPIC:
        stamp = decode_scan(message.data).stamp
    elif message.topic in ROS_TYPES:
        stamp = decode_poses(ROS_TYPES[message.topic], message.data)[0].stamp
    else:
        return message.log_time // 1000 * 1000
    return stamp // 1000 * 1000


def _reduced(message: Message) -> list[bytes]:
    if message.topic == TF_STATIC_TOPIC:
        return [message.data]
    if message.topic == ODOM_TOPIC:
        pose = _odometry(message)
        rounded = Pose2D(*(float(f"{value:.{DECIMALS}f}") for value in _values(pose)))
        return [encode_odometry(_stamp(message), rounded)]
    scan = decode_scan(message.data)
    ranges = np.array([float(f"{z:.{RANGE_DECIMALS}f}") for z in _finite_ranges(scan)], np.float32)
    limits = {"range_min": 0.0, "range_max": float(f"{scan.range_max:.{DECIMALS}f}")}
    timeless = {"time_increment": 0.0, "scan_time": 0.0}
    return [encode_scan(replace(scan, stamp=_stamp(message), ranges=ranges, **limits, **timeless))]
