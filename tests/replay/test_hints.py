"""Every option that an error or a note suggests is taken from what is printed, given, and helps."""

from __future__ import annotations

import ast
import math
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from prim import console
from prim.log.messages import (
    ODOMETRY_TYPE,
    POINT_TYPE,
    POSE_TYPE,
    SCAN_TYPE,
    TF_TYPE,
    encode_odometry,
    encode_point,
    encode_pose,
    encode_scan,
    encode_transforms,
)
from prim.log.writer import LogWriter
from prim.scan import Scan
from prim.se2 import Pose2D
from replay.cli import app

Run = Callable[..., tuple[int, str]]

ROOT = Path(__file__).parents[2]
SECOND = 10**9
SCAN = Scan(0, "laser", -math.pi, 2 * math.pi / 90, 0.1, 5.0, np.full(90, 1.0, dtype=np.float32))


class Topics(NamedTuple):
    """What a small log of ten seconds holds, a message a second on each topic."""

    scans: tuple[str, ...] = ("/scan",)
    frames: tuple[str, ...] = ("laser",)
    odometry: tuple[str, ...] = ("/odom",)
    late: int = 0
    scan: Scan = SCAN
    static: tuple[tuple[str, str], ...] = ()
    moving: tuple[tuple[str, str], ...] = ()
    gps: tuple[str, ...] = ()


PLAIN = Topics()


def write(path: str, topics: Topics = PLAIN) -> str:
    """Write the log; the stamps of its scans are ``late`` seconds off the poses', but not when they were logged."""
    kinds = dict.fromkeys(topics.scans, SCAN_TYPE) | dict.fromkeys(topics.odometry, ODOMETRY_TYPE)
    kinds |= dict.fromkeys(topics.gps, POINT_TYPE) | {"/tf": TF_TYPE, "/tf_static": TF_TYPE}
    with LogWriter(Path(path)) as log:
        for name, kind in kinds.items():
            log.add_topic(name, kind)
        for parent, child in topics.static:
            log.write("/tf_static", 1, encode_transforms([(1, parent, child, Pose2D(0.1, 0, 0))]))
        for second in range(1, 11):
            stamp, pose = second * SECOND, Pose2D(second / 10, 0, 0)
            for name in topics.odometry:
                log.write(name, stamp, encode_odometry(stamp, pose))
            for parent, child in topics.moving:
                log.write("/tf", stamp, encode_transforms([(stamp, parent, child, pose)]))
            for name in topics.gps:
                log.write(name, stamp, encode_point(stamp, pose.x, pose.y))
            for name, frame in zip(topics.scans, topics.frames, strict=True):
                scan = replace(topics.scan, frame_id=frame, stamp=stamp + topics.late * SECOND)
                log.write(name, stamp, encode_scan(scan))
    return path


def truncated() -> list[str]:
    whole = Path(write("whole.mcap")).read_bytes()
    Path("a.mcap").write_bytes(whole[: len(whole) * 9 // 10])
    return ["a.mcap"]


def folder_of_two() -> list[str]:
    Path("bag").mkdir()
    write("bag/one.mcap")
    write("bag/two.mcap")
    return ["bag"]


def split_without_a_part() -> list[str]:
    Path("bag").mkdir()
    write("bag/bag_0.mcap")
    names = "\n".join(f"  - bag_{k}.mcap" for k in range(2))
    Path("bag/metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  relative_file_paths:\n{names}\n")
    return ["bag"]


def cut_gzip() -> list[str]:
    import gzip

    packed = gzip.compress(Path(write("whole.mcap")).read_bytes())
    Path("a.mcap.gz").write_bytes(packed[:-200])
    return ["a.mcap.gz"]


def undecodable() -> list[str]:
    with LogWriter(Path("a.mcap")) as log:
        log.add_topic("/scan", SCAN_TYPE)
        for second in range(1, 4):
            data = encode_scan(replace(SCAN, stamp=second * SECOND))
            log.write("/scan", second * SECOND, data[:60] if second == 2 else data)
    return ["a.mcap", "--standing-still"]


def corrected_carmen() -> list[str]:
    ranges = " ".join(["1.00"] * 180)
    lines = [f"FLASER 180 {ranges} {k / 5} 0 0 {k / 10} 0 0 {k}.0 host {k}.0" for k in range(1, 9)]
    Path("a.log").write_text("\n".join(lines) + "\n")
    return ["a.log"]


def deep_cloud() -> list[str]:
    from mcap.writer import Writer
    from rosbags.typesys import Stores, get_typestore

    from tests.replay.scans.test_clouds import ring

    store = get_typestore(Stores.ROS2_JAZZY)
    new = store.types
    points = np.concatenate([ring(90, height=z, distance=2.0) for z in np.linspace(-0.5, 0.5, 11)]).astype("<f4")
    with Path("a.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        kind = "sensor_msgs/msg/PointCloud2"
        channel = writer.register_channel("/cloud", "cdr", writer.register_schema(kind, "ros2msg", b""))
        for second in range(1, 4):
            header = new["std_msgs/msg/Header"](new["builtin_interfaces/msg/Time"](second, 0), "lidar")
            fields = [new["sensor_msgs/msg/PointField"](name, 4 * k, 7, 1) for k, name in enumerate("xyz")]
            data = points.tobytes()
            cloud = new[kind](
                header, 1, len(points), fields, False, 12, len(data), np.frombuffer(data, np.uint8), True
            )
            writer.add_message(channel, second * SECOND, bytes(store.serialize_cdr(cloud, kind)), second * SECOND)
        writer.finish()
    return ["a.mcap", "--standing-still"]


def turning() -> list[str]:
    """A recorded session whose log does not say where the laser is."""
    from tests.replay.poses.test_mount_estimation import OFF, recorded, without_tf

    return [str(without_tf(recorded(Path.cwd(), 1, OFF, stops=(7, 7)))), "--no-detect"]


def stamped_at_the_end() -> list[str]:
    """A log whose scans are stamped when the sweep ends."""
    from replay.poses.laser_poses import BEAM_TIMES
    from tests.replay.poses.test_sweep import write_log

    return [str(write_log(Path("a.mcap"), BEAM_TIMES["end"]))]


def only(*arguments: str, topics: Topics = PLAIN) -> Callable[[], list[str]]:
    return lambda: [write("a.mcap", topics), *arguments]


def poses_far_away() -> list[str]:
    with LogWriter(Path("a.mcap")) as log:
        log.add_topic("/scan", SCAN_TYPE)
        log.add_topic("/odom", ODOMETRY_TYPE)
        for second in range(1, 4):
            log.write("/scan", second * SECOND, encode_scan(replace(SCAN, stamp=second * SECOND)))
            stamp = (second + 100) * SECOND
            log.write("/odom", second * SECOND, encode_odometry(stamp, Pose2D()))
    return ["a.mcap", "--clock", "header"]


def wide(x: float) -> Callable[[], list[str]]:
    """A robot that is found at two places that are x metres apart."""

    def make() -> list[str]:
        with LogWriter(Path("a.mcap")) as log:
            log.add_topic("/scan", SCAN_TYPE)
            log.add_topic("/pose", POSE_TYPE)
            for second in range(1, 4):
                stamp = second * SECOND
                log.write("/scan", stamp, encode_scan(replace(SCAN, stamp=stamp)))
                log.write("/pose", stamp, encode_pose(stamp, Pose2D(x * second, x * second, 0)))
        return ["a.mcap"]

    return make


FEW = Topics(scan=replace(SCAN, ranges=SCAN.ranges[:3]))
TWO = Topics(scans=("/front", "/rear"), frames=("front", "rear"))
JOINED = TWO._replace(static=(("base_link", "front"), ("base_link", "rear")))
APART = TWO._replace(odometry=(), moving=(("odom", "front"), ("world", "rear")))
ENDLESS = Topics(
    frames=("base_link",),
    scan=replace(SCAN, range_max=math.inf, ranges=np.array([np.inf] * 9 + [1.0] * 81, dtype=np.float32)),
)


class Situation(NamedTuple):
    """Where something is suggested.

    Attributes:
        make: Writes a log, and returns the arguments of a replay.
        suggests: What is suggested, as a regular expression.
        code: The exit code before.
        after: The exit code with what is suggested.
        stays: Whether what suggests it is said even so.
    """

    make: Callable[[], list[str]]
    suggests: str
    code: int = 1
    after: int = 0
    stays: bool = False


SITUATIONS = {
    "truncated": Situation(truncated, "--recover", 1, 3),
    "cut gzip": Situation(cut_gzip, "--recover", 1, 3),
    "undecodable": Situation(undecodable, "--recover", 1, 3),
    "a part is missing": Situation(split_without_a_part, "--recover", 1, 3),
    "two scanners": Situation(only(topics=TWO), r"--scan-topic \S+"),
    "joined scanners": Situation(only(topics=JOINED), r"--scan-topic \S+", 0),
    "one offset of two": Situation(only("--laser-offset", "0.1", "0", "0", topics=JOINED), r"--scan-topic \S+", 2),
    "two odometries": Situation(only(topics=Topics(odometry=("/odom", "/wheels"))), r"--odom-topic \S+"),
    "two gps": Situation(only("--pose", "fused", topics=Topics(gps=("/gps", "/gps_2"))), r"--gps-topic \S+"),
    "no scan is selected": Situation(only("--start", "99"), r"--start \S+"),
    "no poses": Situation(only(topics=Topics(odometry=())), "--standing-still"),
    "no truth": Situation(only("--pose", "truth"), "--pose auto"),
    "no chain in tf": Situation(only("--pose", "tf"), "--pose auto"),
    "nothing to fuse": Situation(
        only("--pose", "fused", topics=Topics(odometry=(), moving=(("odom", "laser"),))), "--pose auto"
    ),
    "poses are not fused": Situation(
        only("--gps-topic", "/gps", topics=Topics(gps=("/gps",), moving=(("map", "laser"),))), "--pose fused", 0
    ),
    "two clocks": Situation(poses_far_away, "--clock log"),
    "fused by two clocks": Situation(
        only("--pose", "fused", "--clock", "header", topics=Topics(late=500)), "--clock log"
    ),
    "a clock is moved": Situation(only(topics=Topics(late=-500)), "--clock header", 0, 1),
    "no mount": Situation(turning, r"to use it: (--laser-offset \S+ \S+ \S+)", 0),
    "the end of a sweep": Situation(stamped_at_the_end, r"--sweep \S+", 0),
    "heights of a 3D lidar": Situation(deep_cloud, r"--slice \S+ \S+"),
    "no longest range": Situation(only(topics=ENDLESS), r"--max-range \d+", 0),
    "corrected poses": Situation(corrected_carmen, r"--odom-topic \S+", 0, stays=True),
    "no noise": Situation(
        only(
            "--sensor-model", "gaussian", "--n-scans", "1", topics=Topics(scan=replace(SCAN, ranges=SCAN.ranges[:3]))
        ),
        r"--noise-std \S+",
    ),
    "a large map": Situation(wide(300.0), r"--resolution \S+"),
    "large bounds": Situation(only("--bounds", "0", "0", "900", "900"), r"--resolution \S+", 2),
    "a large map for forward": Situation(wide(80.0), r"--resolution \S+"),
}


@pytest.fixture
def run(
    in_tmp: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., tuple[int, str]]:
    """Exit code and stderr of a replay."""
    monkeypatch.setattr(sys, "warnoptions", ["error"])

    def replayed(*arguments: str) -> tuple[int, str]:
        from replay.cli import join_bounds

        fixed = ["--no-viewer", "--no-detect", "--report", "r.json", "--force", "--resolution", "0.02"]
        given = [*fixed[:-2], *arguments] if "--resolution" in arguments else [*fixed, *arguments]
        code = console.run(app, "prim-replay", join_bounds(given))
        return code, capsys.readouterr().err

    return replayed


@pytest.mark.parametrize("name", SITUATIONS)
def test_what_is_suggested_helps(name: str, run: Run) -> None:
    situation = SITUATIONS[name]
    arguments = situation.make()
    if name == "a large map for forward":
        arguments += ["--mapper", "forward"]
    code, printed = run(*arguments)
    found = re.search(situation.suggests, printed)
    assert (code, bool(found)) == (situation.code, True), printed
    assert found
    suggestion = found[found.lastindex or 0].rstrip(";:,.)")
    before = next(line for line in printed.splitlines() if suggestion in line)
    after_code, after = run(*arguments, *suggestion.split())
    assert after_code == situation.after, after
    assert (before in after) == situation.stays


OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]+")
OF_USAGE = re.compile(r"^--|excludes|goes? with|stands in|is not used|are not used|changes nothing")
"""What says which options go together, and suggests none."""
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef)

SUGGESTING = ("prim/log", "replay/scans", "replay/poses", "replay/mapping_stage.py", "replay/localization.py")
"""Where errors and notes suggest options."""

ELSEWHERE = {
    "--compass-topic": "as --gps-topic",
    "--no-deskew": "as --sweep",
    "--keep": "of gzip and zstd: tests/prim/log/test_log_file.py",
    "--bounds": "what the user knows",
}
"""Options that are suggested and not given here, and why."""


def test_every_option_that_is_suggested_is_given() -> None:
    given = {option for situation in SITUATIONS.values() for option in OPTION.findall(situation.suggests)}
    places = [ROOT / part for part in SUGGESTING]
    paths = [path for place in places for path in ([place] if place.is_file() else place.rglob("*.py"))]
    suggested = set()
    for path in paths:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        documents = {ast.get_docstring(node, clean=False) for node in ast.walk(tree) if isinstance(node, DOCUMENTED)}
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value not in documents:
                suggested |= {option for option in OPTION.findall(node.value) if not OF_USAGE.search(node.value)}
    assert suggested <= given | ELSEWHERE.keys()
