"""What the errors and notes of a replay suggest is taken from what is printed, as it stands, and helps."""

from __future__ import annotations

import bz2
import gzip
import lzma
import math
import sys
import tarfile
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from detect.networks.weights import SHIPPED
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
from prim.parameters import name_parameters
from prim.scan import Scan
from prim.se2 import Pose2D
from replay.cli import app, join_bounds
from replay.keywords import PARAMETERS, SWITCHES
from tests import hints

Run = Callable[..., tuple[int, str]]

SECOND = 10**9
QUICK = ("--no-viewer", "--no-detect", "--report", "r.json", "--force", "--resolution", "0.02")
"""Arguments with which a replay takes little time."""

SCAN = Scan(0, "laser", -math.pi, 2 * math.pi / 90, 0.1, 5.0, np.full(90, 1.0, dtype=np.float32))


API_PARAMETERS, API_SWITCHES = {*PARAMETERS, "save"}, {*SWITCHES, "force"}


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
    packed = gzip.compress(Path(write("whole.mcap")).read_bytes())
    Path("a.mcap.gz").write_bytes(packed[:-200])
    return ["a.mcap.gz"]


def part_alone() -> list[str]:
    """One of two parts of a bag, the other one beside it; the folder's name has a space."""
    split_without_a_part()
    write("bag/bag_1.mcap")
    Path("bag").rename("my bag")
    return ["my bag/bag_0.mcap"]


def damaged_database() -> list[str]:
    """A ROS 2 bag whose last pages are missing."""
    from tests.encodings.content import read_content
    from tests.encodings.ros2 import write_db3_foxy

    path = write_db3_foxy(read_content(Path(write("a.mcap"))), Path.cwd())
    Path("b.db3").write_bytes(path.read_bytes()[:-8192])
    return ["b.db3"]


def damaged_bag() -> list[str]:
    """A ROS 1 bag whose end is missing."""
    from tests.encodings.content import read_content
    from tests.encodings.ros1 import write_bag

    path = write_bag(read_content(Path(write("a.mcap"))), Path.cwd())
    Path("b.bag").write_bytes(path.read_bytes()[: path.stat().st_size * 9 // 10])
    return ["b.bag"]


def packed(pack: Callable[[Path, Path], object], name: str = "my log") -> Callable[[], list[str]]:
    """A log that another program packed, under a name with a space."""

    def make() -> list[str]:
        write("whole.mcap")
        pack(Path("whole.mcap"), Path(name))
        Path("whole.mcap").unlink()
        return [name]

    return make


def pack_tar(source: Path, target: Path) -> None:
    with tarfile.open(target, "w") as archive:
        archive.add(source)


def pack_zip(source: Path, target: Path) -> None:
    with zipfile.ZipFile(target, "w") as archive:
        archive.write(source)


def pack_lz4(source: Path, target: Path) -> None:
    hints.run_in_shell(f"lz4 -q {source} '{target}'")


def pack_five_times(source: Path, target: Path) -> None:
    data = source.read_bytes()
    for _ in range(5):
        data = gzip.compress(data)
    target.write_bytes(data)


def clocks(
    scans: Callable[[int], int] = lambda second: second, poses: Callable[[int], int] = lambda second: second
) -> Callable[[], list[str]]:
    """A log of 30 s whose scans and poses have these stamps (s)."""

    def make() -> list[str]:
        with LogWriter(Path("a.mcap")) as log:
            log.add_topic("/scan", SCAN_TYPE)
            log.add_topic("/odom", ODOMETRY_TYPE)
            for second in range(1, 31):
                log_time, stamp = second * SECOND, poses(second) * SECOND
                log.write("/odom", log_time, encode_odometry(stamp, Pose2D(second / 10, 0, 0)))
                log.write("/scan", log_time, encode_scan(replace(SCAN, stamp=scans(second) * SECOND)))
        return ["a.mcap"]

    return make


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


def poses_that_are_not_numbers() -> list[str]:
    with LogWriter(Path("a.mcap")) as log:
        log.add_topic("/scan", SCAN_TYPE)
        log.add_topic("/odom", ODOMETRY_TYPE)
        for second in range(1, 4):
            stamp = second * SECOND
            log.write("/scan", stamp, encode_scan(replace(SCAN, stamp=stamp)))
            log.write("/odom", stamp, encode_odometry(stamp, Pose2D(math.nan, 0, 0)))
    return ["a.mcap"]


def poses_far_away() -> list[str]:
    with LogWriter(Path("a.mcap")) as log:
        log.add_topic("/scan", SCAN_TYPE)
        log.add_topic("/odom", ODOMETRY_TYPE)
        for second in range(1, 4):
            log.write("/scan", second * SECOND, encode_scan(replace(SCAN, stamp=second * SECOND)))
            stamp = (second + 100) * SECOND
            log.write("/odom", second * SECOND, encode_odometry(stamp, Pose2D()))
    return ["a.mcap", "--clock", "header"]


def wide(x: float, *arguments: str) -> Callable[[], list[str]]:
    """A robot that is found at two places that are x metres apart."""

    def make() -> list[str]:
        with LogWriter(Path("a.mcap")) as log:
            log.add_topic("/scan", SCAN_TYPE)
            log.add_topic("/pose", POSE_TYPE)
            for second in range(1, 4):
                stamp = second * SECOND
                log.write("/scan", stamp, encode_scan(replace(SCAN, stamp=stamp)))
                log.write("/pose", stamp, encode_pose(stamp, Pose2D(x * second, x * second, 0)))
        return ["a.mcap", *arguments]

    return make


def earlier_file() -> list[str]:
    """A file of somebody else in the place of the report."""
    Path("r.json").write_text("mine")
    return [write("a.mcap")]


def noisy() -> list[str]:
    """Ranges with more noise than a round room of 2 m has room for."""
    rng = np.random.default_rng(1)
    with LogWriter(Path("a.mcap")) as log:
        log.add_topic("/scan", SCAN_TYPE)
        for second in range(1, 31):
            ranges = (1.0 + 0.3 * rng.standard_normal(90)).astype(np.float32)
            log.write("/scan", second * SECOND, encode_scan(replace(SCAN, stamp=second * SECOND, ranges=ranges)))
    return ["a.mcap", "--standing-still"]


FEW = Topics(scan=replace(SCAN, ranges=SCAN.ranges[:3]))
SPACE = Topics(scans=("/my scan", "/rear"), frames=("front", "rear"))
TWO = Topics(scans=("/front", "/rear"), frames=("front", "rear"))
JOINED = TWO._replace(static=(("base_link", "front"), ("base_link", "rear")))
APART = TWO._replace(odometry=(), moving=(("odom", "front"), ("world", "rear")))
ENDLESS = Topics(
    frames=("base_link",),
    scan=replace(SCAN, range_max=math.inf, ranges=np.array([np.inf] * 9 + [1.0] * 81, dtype=np.float32)),
)
TOO_FAR = Topics(scan=replace(SCAN, range_max=5e4, ranges=np.array([4.5e4] * 9 + [1.0] * 81, dtype=np.float32)))

MANY = Topics(scan=replace(SCAN, angle_increment=2 * math.pi / 30_000, ranges=np.full(30_000, 1.0, dtype=np.float32)))

Taking = Callable[[list[str], str], list[str]]


def option(arguments: list[str], text: str) -> list[str]:
    """Give the first option of the text besides."""
    return [*arguments, *hints.suggested_option(text, app)]


def in_place_of(name: str) -> Taking:
    """Give the first option of the text in place of one that was given, wherever it was."""

    def take(arguments: list[str], text: str) -> list[str]:
        return [*arguments[: arguments.index(name)], *hints.suggested_option(text, app)]

    return take


def four_numbers(arguments: list[str], text: str) -> list[str]:
    """Give the bounds that the text ends with."""
    return [*arguments, "--bounds", *text.split()[-4:]]


def path(arguments: list[str], text: str) -> list[str]:
    """Replay the log that the text ends with."""
    return [hints.suggested_path(text), *arguments[1:]]


def tool(arguments: list[str], text: str) -> list[str]:
    """Run the command that the text ends with, and replay what it makes."""
    (made,) = hints.run_in_shell(text.partition("with: ")[2])
    return [str(made), *arguments[1:]]


def listed(of: str, after: str) -> Taking:
    """Give the first of the values that are listed after some words, in place of the one that was given."""
    return lambda arguments, text: hints.replaced(arguments, of, hints.suggested_value(text.partition(after)[2]))


class Situation(NamedTuple):
    """Where something is suggested.

    Attributes:
        make: Writes a log, and returns the arguments of a replay.
        hint: What is printed where the suggestion begins; words of one text in the sources.
        take: Changes the arguments as the rest of the printed line suggests.
        code: The exit code before.
        after: The exit code with what is suggested.
        stays: Whether what suggests it is said even so.
        fixed: Arguments that are given besides.
    """

    make: Callable[[], list[str]]
    hint: str
    take: Taking = option
    code: int = 1
    after: int = 0
    stays: bool = False
    fixed: tuple[str, ...] = QUICK


SITUATIONS = {
    "truncated": Situation(truncated, "read what is left of it with --recover", after=3),
    "cut gzip": Situation(cut_gzip, "read what is left of it with --recover", after=3),
    "damaged database": Situation(damaged_database, "read what is left of it with --recover", after=3),
    "damaged bag": Situation(damaged_bag, "read what is left of it with --recover", after=3),
    "undecodable": Situation(undecodable, "pass over such messages with --recover", after=3),
    "a part is missing": Situation(split_without_a_part, "read the rest with --recover", after=3),
    "a part alone": Situation(part_alone, "for all give", path, 0),
    "folder of two": Situation(folder_of_two, "give one of them", path),
    "tar": Situation(packed(pack_tar), "unpack it with: tar", tool),
    "zip": Situation(packed(pack_zip), "unpack it with: unzip", tool),
    "bzip2": Situation(
        packed(lambda a, b: b.write_bytes(bz2.compress(a.read_bytes()))), "unpack it with: bzip2 -dc", tool
    ),
    "xz": Situation(
        packed(lambda a, b: b.write_bytes(lzma.compress(a.read_bytes()))), "unpack it with: xz -dc", tool
    ),
    "lz4": Situation(packed(pack_lz4), "unpack it with: lz4 -dc", tool),
    "five times gzip": Situation(packed(pack_five_times), "unpack it with: {} -dc", tool),
    "two scanners": Situation(only(topics=TWO), "choose one with --scan-topic"),
    "a topic with a space": Situation(only(topics=SPACE), "choose one with --scan-topic"),
    "joined scanners": Situation(only(topics=JOINED), "for one of them give --scan-topic", code=0),
    "no such scans": Situation(
        only("--scan-topic", "/scam"), "its scan topics", listed("--scan-topic", "its scan topics: ")
    ),
    "one offset of two": Situation(
        only("--laser-offset", "0.1", "0", "0", topics=JOINED), "goes with one scanner: give --scan-topic {}", code=2
    ),
    "scanners in two trees": Situation(
        only("--scan-topic", "/front", "--scan-topic", "/rear", topics=APART),
        "choose one scanner with",
        in_place_of("--scan-topic"),
    ),
    "two odometries": Situation(only(topics=Topics(odometry=("/odom", "/wheels"))), "choose one with --odom-topic"),
    "no such poses": Situation(
        only("--odom-topic", "/odo"), "topics with poses", listed("--odom-topic", "topics with poses: ")
    ),
    "two gps": Situation(only("--pose", "fused", topics=Topics(gps=("/gps", "/gps_2"))), "choose one with {} {}"),
    "no such gps": Situation(
        only("--pose", "fused", "--gps-topic", "/gpt", topics=Topics(gps=("/gps",))),
        "topics with such messages",
        listed("--gps-topic", "topics with such messages: "),
    ),
    "no scan is selected": Situation(only("--start", "99"), "begin with the first one"),
    "no poses": Situation(only("--pose", "odom", topics=Topics(odometry=())), "find them by the scans alone"),
    "no usable poses": Situation(poses_that_are_not_numbers, "to map with the robot at rest"),
    "no truth": Situation(only("--pose", "truth"), "take what poses there are"),
    "no chain in tf": Situation(only("--pose", "tf"), "take what poses there are"),
    "nothing to fuse": Situation(
        only("--pose", "fused", topics=Topics(odometry=(), moving=(("odom", "laser"),))), "take what poses there are"
    ),
    "poses are not fused": Situation(
        only("--gps-topic", "/gps", topics=Topics(gps=("/gps",), moving=(("map", "laser"),))),
        "nothing is fused, since there are poses on",
        code=0,
    ),
    "two clocks": Situation(poses_far_away, "two clocks in one log?"),
    "fused by two clocks": Situation(
        only("--pose", "fused", "--clock", "header", topics=Topics(late=500)), "two clocks in one log?"
    ),
    "a clock is moved": Situation(
        only(topics=Topics(late=-500)), "the poses by when both were logged", code=0, after=1
    ),
    "poses on another clock": Situation(
        clocks(poses=lambda second: second - 5000), "the scans by when both were logged", code=0, after=1
    ),
    "stamps of 0": Situation(
        clocks(scans=lambda second: 0), "the times at which messages were logged are used", code=0, after=1
    ),
    "single stamps of 0": Situation(
        clocks(scans=lambda second: second * (second != 5)), "the times at which these messages were logged", code=0
    ),
    "a clock is set back": Situation(
        clocks(*2 * [lambda second: second % 15]), "stamps from then on are moved behind those before", code=0
    ),
    "no mount": Situation(turning, "to use it: --laser-offset", code=0),
    "the end of a sweep": Situation(stamped_at_the_end, "scans fit each other best where", code=0),
    "heights of a 3D lidar": Situation(deep_cloud, "choose a slice"),
    "no longest range": Situation(only(topics=ENDLESS), "if it is known, give it, as in", code=0),
    "too long ranges": Situation(
        only("--bounds", "-2", "-2", "2", "2", topics=TOO_FAR), "where they end is not on the map; give", code=0
    ),
    "noise beyond the bounds": Situation(noisy, "for all of them give --bounds", four_numbers, 0),
    "too many rays for the memory": Situation(
        only("--mapper", "forward", "--max-memory", "0.305", topics=MANY), "replay fewer scans with --stride {}, or"
    ),
    "too many cells for the memory": Situation(only("--max-memory", "0.3"), "allow it with --max-memory"),
    "corrected poses": Situation(corrected_carmen, "for the robot's own give", code=0, stays=True),
    "no noise": Situation(
        only("--sensor-model", "gaussian", "--n-scans", "1", topics=FEW), "give it, such as --noise-std"
    ),
    "a large map": Situation(wide(300.0), "give --resolution {} or a coarser one; where"),
    "large bounds": Situation(
        only("--bounds", "0", "0", "900", "900"), "give --resolution {} or a coarser one, or", code=2
    ),
    "a large map for forward": Situation(
        wide(80.0, "--mapper", "forward"), "give --resolution {} or a coarser one; where"
    ),
    "another file": Situation(
        earlier_file, "or --force to replace it", code=2, fixed=tuple(word for word in QUICK if word != "--force")
    ),
    "no display": Situation(
        only("--spawn"), "save with --save OUT.rrd", in_place_of("--spawn"), code=2, fixed=("--no-detect",)
    ),
    "no address": Situation(
        only("--connect", "nonsense"), "give an address such as", listed("--connect", "such as "), 2, 1, fixed=()
    ),
    "no interval": Situation(
        only("--detect-every", "day"),
        "give a number of scans, or end",
        listed("--detect-every", "scans, or "),
        code=2,
        fixed=("--no-viewer",),
    ),
    "weights of another mapper": Situation(
        only("--weights", str(SHIPPED / "det")),
        "reads the maps of {}, not of {}: use --mapper",
        fixed=("--no-viewer",),
    ),
    "slice upside down": Situation(
        lambda: [*deep_cloud(), "--slice", "0.1", "-0.1"], "give two heights, the lower first", code=2
    ),
    "no bounds": Situation(
        only("--bounds", "all"), "give auto, or four numbers", code=2, take=listed("--bounds", "give ")
    ),
}


@pytest.fixture
def run(
    in_tmp: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., tuple[int, str]]:
    """Exit code and stderr of a replay."""
    monkeypatch.setattr(sys, "warnoptions", ["error"])
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)

    def replayed(*arguments: str) -> tuple[int, str]:
        code = console.run(app, "prim-replay", join_bounds(arguments))
        return code, capsys.readouterr().err

    return replayed


@pytest.mark.parametrize("name", SITUATIONS)
def test_what_is_suggested_helps(name: str, run: Run) -> None:
    situation = SITUATIONS[name]
    arguments = situation.make()
    code, printed = run(*situation.fixed, *arguments)
    assert code == situation.code, printed
    suggestion = hints.find(situation.hint, printed)
    assert suggestion, printed
    code, after = run(*situation.fixed, *situation.take(arguments, suggestion))
    assert code == situation.after, after
    assert bool(hints.find(situation.hint, after)) == situation.stays, after
    left = hints.OPTION.findall(name_parameters(suggestion, API_PARAMETERS, API_SWITCHES))
    assert {*left} <= {"--serve"}, "an option of the command line in a message of the API"
