"""Reading CARMEN's text logs: a message in each line, scans with the robot's pose in them.

The formats are those of the Carnegie Mellon Robot Navigation Toolkit: FLASER and RLASER (readings over half a turn),
ROBOTLASER and RAWLASER (with their angles and range), ODOM and PARAM.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from typing import NamedTuple, TypeGuard

import numpy as np

from prim.errors import LogReadError
from prim.log.decoding.cdr import SECOND
from prim.log.decoding.codecs import Codec, Content
from prim.log.decoding.values import StampedPose, checked_stamp, quaternion
from prim.log.limits import ROW_LIMITS, records_limit
from prim.log.log_file import LogFile
from prim.log.reader import RECOVER_HINT, LogReader
from prim.log.source import Message, Topic
from prim.scan import Scan
from prim.se2 import Pose2D, wrap_angle
from prim.strict_json import SHOWN

BYTE_ORDER_MARK = b"\xef\xbb\xbf"
"""How a text begins that an editor saved as UTF-8."""

START = re.compile(
    rb"(\xef\xbb\xbf)?([^\S\n]*+(#[^\n]*+)?\n)*+[^\S\n]*+(PARAM|SYNC|ODOM|TRUEPOS|[FR]LASER|ROBOTLASER\d|RAWLASER\d|NMEAGGA|NMEARMC|NEFF)\s"
)
"""How a log of CARMEN begins: behind comments and empty lines, with one of its messages.

All repetitions are possessive: else texts of blank lines would take for ever.
"""

PLAIN_LASER, LASER = re.compile(r"[FR]LASER"), re.compile(r"(ROBOT|RAW)LASER\d")
ODOM = "ODOM"
ROBOT_POSES = "robot_poses"
"""The topic of the robot's poses in the lines of scans."""
CORRECTED_POSES = "laser_poses"
"""The topic of the laser's poses in the lines of scans, where these are no constant offset from the robot's."""
STATIC_TRANSFORMS = "tf_static"
ODOM_FRAME, BASE_FRAME = "odom", "base_link"

DEFAULT_MAX_RANGE = 80.0
"""The longest range (m) of a scan whose line and log give none: a SICK LMS says 81.83 and above for no return."""

MAX_RANGE_PARAMETERS = {
    "FLASER": ("robot_front_laser_max", "laser_front_laser_max", "robot_frontlaser_max"),
    "RLASER": ("robot_rear_laser_max", "laser_rear_laser_max", "robot_rearlaser_max"),
}

NARROW_FIELDS = {400: math.radians(100), 401: math.radians(100)}
"""Scanners whose number of readings means another field of view (rad) than half a turn."""

CONSTANT_MOUNT = (0.02, math.radians(1.0))
"""The laser's pose on the robot is constant if it stays within this (m, rad): poses have few digits."""

MIN_MOUNT = (2e-3, math.radians(0.1))
"""A laser's pose within this (m, rad) of the robot's is the same pose: the log does not say where the laser is."""

SAME_LASERS = {"FLASER": "ROBOTLASER1", "RLASER": "ROBOTLASER2"}
"""Lines that newer versions write besides those of earlier ones, of the same scans."""

_PARTNERS = SAME_LASERS | {full: plain for plain, full in SAME_LASERS.items()}

REPEATED_SHARE = 0.9
"""A kind of line repeats another one if this share of its scans has the time of one of that; set by hand."""

COARSE_SHARE = 0.5
"""Where fewer than this share of the scans have a time of their own, times are too coarse to be used."""

LINE_LIMIT = 1 << 22
"""Lines are no longer (bytes): a scan of 2^19 readings is not. Taken apart, one takes 30 times as much memory."""

BLOCK_BYTES = 1 << 20
"""So much is read at once."""

FAR = 1e9
"""Poses beyond it (m, rad) tell nothing of the laser's place on the robot."""

SPACING = SECOND // 10
"""The time from one scan to the next (ns) that stands in for times that are too coarse."""


class _Line(NamedTuple):
    """A line that holds a message.

    Attributes:
        name: The message's name.
        fields: What follows it.
    """

    name: str
    fields: list[str]


class _LaserLine(NamedTuple):
    """The fields of a line with a scan.

    Attributes:
        angle_min: Bearing of the first reading (rad).
        increment: From one reading's bearing to the next one's (rad).
        max_range: The longest range (m); None where the line does not say.
        readings: The readings (m), as text.
        laser_pose: x, y (m), heading (rad) of the laser; None where the line has no poses.
        robot_pose: The same of the robot.
        stamp: When the scan was taken (s), as text.
    """

    angle_min: float
    increment: float
    max_range: float | None
    readings: list[str]
    laser_pose: Pose2D | None
    robot_pose: Pose2D | None
    stamp: str


class _Mount:
    """A laser's pose on the robot, by the poses of both in the lines of its scans."""

    def __init__(self) -> None:
        self.constant = True
        self._first: Pose2D | None = None
        self._sum = np.zeros(3)
        self._count = 0

    def add(self, mount: Pose2D) -> None:
        """Add what a line says."""
        first = self._first = self._first or mount
        turn = wrap_angle(mount.theta - first.theta)
        if math.hypot(mount.x - first.x, mount.y - first.y) > CONSTANT_MOUNT[0] or abs(turn) > CONSTANT_MOUNT[1]:
            self.constant = False
        self._sum += mount.x, mount.y, turn
        self._count += 1

    @property
    def mean(self) -> Pose2D:
        """The mean over all lines, since each has few digits."""
        x, y, turn = (self._sum / max(self._count, 1)).tolist()
        return Pose2D(x, y, wrap_angle(turn + (self._first.theta if self._first else 0.0)))

    @property
    def differs(self) -> bool:
        """Whether the laser's poses are other ones than the robot's."""
        mean = self.mean
        return math.hypot(mean.x, mean.y) > MIN_MOUNT[0] or abs(mean.theta) > MIN_MOUNT[1]


class _Motion:
    """Whether poses differ from each other."""

    def __init__(self) -> None:
        self.found = False
        self._first: Pose2D | None = None

    def add(self, pose: Pose2D) -> None:
        """Add a pose."""
        first = self._first = self._first or pose
        self.found |= (pose.x, pose.y, pose.theta) != (first.x, first.y, first.theta)


class CarmenReader(LogReader):
    """A log of CARMEN that is open for reading: a :class:`prim.log.source.LogSource`.

    Each kind of line is a topic: FLASER, ROBOTLASER1, ODOM. The robot's poses in the lines of scans are the topic
    ROBOT_POSES, their laser's pose on the robot a static transform.

    Args:
        file: The file, unpacked.
        recover: Pass over lines that cannot be decoded.

    Raises:
        LogReadError: The file cannot be read.
    """

    _FORMAT = "CARMEN log"

    def __init__(self, file: LogFile, recover: bool = False) -> None:
        super().__init__(file.path, recover, file)
        try:
            self._file = file.data.open("rb")
        except OSError as error:
            raise LogReadError(file.path, f"cannot be read: {error.strerror or error}") from error
        self._max_range: dict[str, float] = {}
        self._counts: Counter[str] = Counter()
        self._mounts: dict[str, _Mount] = {}
        self._repeated: Counter[str] = Counter()
        self._first_time = 0
        self._even_times = self._is_cut = False
        try:
            self._survey()
        except BaseException:
            self._file.close()
            raise
        self.topics = self._find_topics()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @property
    def messages_lost(self) -> int | None:
        """The number of messages that could not be read; None where the log does not say how many there were."""
        return None if self._is_cut else super().messages_lost

    def _survey(self) -> None:
        """Read all lines once: count them, and find the parameters, the mounts of the lasers, and usable times."""
        stamps: dict[str, str] = {}
        distinct = 0
        in_scans, in_odometry = _Motion(), _Motion()
        for line in self._lines():
            if line.name == "PARAM" and len(line.fields) >= 2:
                self._read_parameter(*line.fields[:2])
            elif _is_topic(line.name):
                self._counts[line.name] += 1
                stamp = self._survey_odometry(line, in_odometry) or self._survey_scan(line, in_scans)
                distinct += bool(stamp) and stamp != stamps.get(line.name)
                stamps[line.name] = stamp
                self._repeated[line.name] += bool(stamp) and stamp == stamps.get(_PARTNERS.get(line.name, ""))
        scans = sum(count for name, count in self._counts.items() if name != ODOM)
        self._even_times = scans > 1 and distinct < COARSE_SHARE * scans
        if self._even_times:
            step = SPACING / SECOND
            self.notes.append(
                f"its times are too coarse ({distinct} for {scans} scans): scans are taken to be {step:g} s apart"
            )
        if self._mounts and in_odometry.found and not in_scans.found:
            self._mounts.clear()
            self.notes.append(f"the poses in the lines of scans are all the same: those of {ODOM} are used")

    def _survey_odometry(self, line: _Line, motion: _Motion) -> str:
        """Take note of motion in a line of odometry; return nothing."""
        if line.name == ODOM and not motion.found:
            with suppress(ValueError):  # an error, or a loss, when it is decoded
                motion.add(_odometry_line(line)[0])
        return ""

    def _survey_scan(self, line: _Line, motion: _Motion) -> str:
        """Take note of a scan's mount and of the time of the first one; return its stamp, empty without one."""
        if line.name == ODOM:
            return ""
        try:
            scan = _laser_line(line)
            self._first_time = self._first_time or _nanoseconds(scan.stamp)
        except ValueError:
            return ""  # an error, or a loss, when it is decoded
        if _is_near(scan.laser_pose) and _is_near(scan.robot_pose):
            self._mounts.setdefault(line.name, _Mount()).add(scan.robot_pose.inverse() @ scan.laser_pose)
            motion.add(scan.robot_pose)
        return scan.stamp

    def _read_parameter(self, name: str, value: str) -> None:
        for laser, names in MAX_RANGE_PARAMETERS.items():
            if name in names and _is_number(value) and float(value) > 0:
                self._max_range[laser] = float(value)

    def _find_topics(self) -> dict[str, Topic]:
        topics = []
        for name, count in self._counts.items():
            content: Content | None = Content.SCAN
            if self._is_repeated(name):
                content = None
            elif name == ODOM:  # the poses in the lines of scans are those of their times
                content = Content.POSE if self._mounts else Content.ODOMETRY
            topics.append(Topic(name, name, "carmen", count, content))
        if self._mounts:
            poses = sum(self._counts[name] for name in self._mounts)
            constant = all(mount.constant for mount in self._mounts.values())
            robot = Content.ODOMETRY if constant else Content.POSE
            topics.append(Topic(ROBOT_POSES, "robot pose", "carmen", poses, robot))
            if not constant:
                topics.append(Topic(CORRECTED_POSES, "laser pose", "carmen", poses, Content.ODOMETRY))
                self.notes += [
                    "the laser's poses are no constant offset from the robot's: they are taken to be corrected ones; "
                    f"for the robot's own give --odom-topic {ROBOT_POSES}",
                ]
            elif any(mount.differs for mount in self._mounts.values()):
                topics.append(Topic(STATIC_TRANSFORMS, "laser mount", "carmen", 1, Content.TRANSFORMS))
        return {topic.name: topic for topic in topics}

    def _is_repeated(self, name: str) -> bool:
        """Return whether the scans of a kind of line are those of another one, and note that."""
        other = SAME_LASERS.get(name)
        if other is None or self._repeated[name] + self._repeated[other] < REPEATED_SHARE * self._counts[name]:
            return False
        self.notes.append(f"{name} has the scans of {other} once more: they are not used")
        return True

    def messages(self, *topics: str) -> Iterator[Message]:
        """See :meth:`prim.log.source.LogSource.messages`; the data of a message is its line."""
        if STATIC_TRANSFORMS in topics and STATIC_TRANSFORMS in self.topics:
            yield Message(STATIC_TRANSFORMS, self._first_time, b"")
        scans = 0
        for line in self._lines():
            if not _is_topic(line.name):
                continue
            scans += line.name != ODOM
            names = [name for name in self._topics_of(line) if name in topics]
            if not names:
                continue
            data = " ".join((line.name, *line.fields))
            if self._even_times:
                time = self._first_time + scans * SPACING
                data = f"{time} {data}"
            else:
                time = _logged(line)
            for name in names:
                yield Message(name, time, data.encode())

    def _topics_of(self, line: _Line) -> list[str]:
        with_poses = line.name in self._mounts
        return [line.name, *((ROBOT_POSES, CORRECTED_POSES) if with_poses else ())]

    def _lines(self) -> Iterator[_Line]:
        """Yield the lines that are no comments. Raises LogReadError where they are damaged, or too many."""
        count, limit = 0, records_limit(self.file_bytes, ROW_LIMITS)
        sizes: dict[str, int] = {}
        for lines, is_ended in self._blocks():
            count += len(lines)
            if count > limit:
                hint = self._file_of_log.unpack_hint if self._file_of_log else ""
                raise LogReadError(self.path, f"more than {limit} lines in {self.file_bytes} bytes", hint)
            for line in lines:
                text = line.removeprefix(BYTE_ORDER_MARK).decode("utf-8", "replace")
                name, *fields = text.split() or ["#"]
                if name.startswith("#"):
                    continue
                if "\0" in text:
                    self._damage("lines with bytes that are no text")
                elif not is_ended and len(fields) < sizes.get(name, 0):
                    self._damage("a last line that is cut")
                else:
                    sizes[name] = len(fields)
                    yield _Line(name, fields)

    def _blocks(self) -> Iterator[tuple[list[bytes], bool]]:
        """Yield the file in lists of lines, and whether these are ended; lines that are too long are left out."""
        at, rest, is_cut = 0, b"", False
        while True:
            self._file.seek(at)  # several readers may be at work
            block = self._file.read(BLOCK_BYTES)
            at += len(block)
            lines = (rest + block).split(b"\n")
            rest = lines.pop()
            if is_cut and lines:  # the end of a line that was too long
                del lines[0]
                is_cut = False
            if is_cut or len(rest) > LINE_LIMIT:
                self._damage(f"lines of more than {LINE_LIMIT} bytes")
                rest, is_cut = b"", True
            yield lines, True
            if not block:
                yield [rest], False
                return

    def _damage(self, what: str) -> None:
        """Note what is lost; unless recovering, raise LogReadError."""
        if not self._recover:
            raise LogReadError(self.path, f"damaged: it has {what}", RECOVER_HINT)
        self._is_cut = True
        self._lose(what)

    def _codec(self, topic: Topic) -> Codec:
        if topic.content is Content.SCAN:
            return Codec(self._decode_scan, self._decode_stamp)
        if topic.content is Content.TRANSFORMS:
            return Codec(self._decode_mounts, lambda data: self._first_time)
        reads_laser = topic.name == CORRECTED_POSES
        return Codec(lambda data: [self._decode_pose(data, reads_laser)], self._decode_stamp)

    def _split(self, data: bytes) -> tuple[int | None, _Line]:
        """Return the time (ns) that stands in for a coarse one, and the line."""
        first, *rest = data.decode().split()
        return (int(first), _Line(rest[0], rest[1:])) if self._even_times else (None, _Line(first, rest))

    def _decode_stamp(self, data: bytes) -> int:
        time, line = self._split(data)
        if time is not None:
            return time
        return _nanoseconds(_odometry_line(line)[1] if line.name == ODOM else _laser_line(line).stamp)

    def _decode_scan(self, data: bytes) -> Scan:
        time, line = self._split(data)
        scan = _laser_line(line)
        longest = scan.max_range or self._max_range.get(line.name, DEFAULT_MAX_RANGE)
        stamp = _nanoseconds(scan.stamp) if time is None else time
        with np.errstate(over="ignore"):  # what is beyond single precision is infinite
            ranges = np.array(scan.readings, dtype=np.float32)
            first, increment, limit = map(_rounded, (scan.angle_min, scan.increment, longest))
        return Scan(stamp, line.name.lower(), first, increment, 0.0, limit, ranges)

    def _decode_pose(self, data: bytes, reads_laser: bool) -> StampedPose:
        time, line = self._split(data)
        if line.name == ODOM:
            pose, text = _odometry_line(line)
        else:
            scan = _laser_line(line)
            found, text = (scan.laser_pose if reads_laser else scan.robot_pose), scan.stamp
            if found is None:
                raise ValueError("a line without poses")
            pose = found
        if math.isinf(pose.theta):
            raise ValueError("its heading is infinite")
        child = line.name.lower() if reads_laser else BASE_FRAME
        return _stamped(_nanoseconds(text) if time is None else time, ODOM_FRAME, child, pose)

    def _decode_mounts(self, data: bytes) -> list[StampedPose]:
        return [
            _stamped(self._first_time, BASE_FRAME, name.lower(), mount.mean) for name, mount in self._mounts.items()
        ]


def _is_topic(name: str) -> bool:
    return name == ODOM or bool(PLAIN_LASER.fullmatch(name) or LASER.fullmatch(name))


def _laser_line(line: _Line) -> _LaserLine:
    """Take a line with a scan apart. Raises ValueError."""
    try:
        return _plain_laser_line(line.fields) if PLAIN_LASER.fullmatch(line.name) else _full_laser_line(line)
    except IndexError:
        raise ValueError(f"a {line.name} of {len(line.fields)} fields ends early") from None


def _plain_laser_line(fields: list[str]) -> _LaserLine:
    count = _count(fields, 0)
    field = NARROW_FIELDS.get(count, math.pi)
    increment = field / max(count - 1 if count % 2 else count, 1)
    laser, robot = _pose(fields, count + 1), _pose(fields, count + 4)
    return _LaserLine(-field / 2, increment, None, fields[1 : count + 1], laser, robot, fields[count + 7])


def _full_laser_line(line: _Line) -> _LaserLine:
    fields = line.fields
    start, increment, longest = float(fields[1]), float(fields[3]), float(fields[4])
    count = _count(fields, 7)
    at = 8 + count
    at += 1 + _count(fields, at)
    readings = fields[8 : 8 + count]
    if line.name.startswith("RAW"):
        return _LaserLine(start, increment, longest or None, readings, None, None, fields[at])
    return _LaserLine(
        start, increment, longest or None, readings, _pose(fields, at), _pose(fields, at + 3), fields[at + 11]
    )


def _odometry_line(line: _Line) -> tuple[Pose2D, str]:
    """Return the pose and the time (s, as text) of an ODOM line. Raises ValueError."""
    try:
        return _pose(line.fields, 0), line.fields[6]
    except IndexError:
        raise ValueError(f"an ODOM of {len(line.fields)} fields ends early") from None


def _count(fields: list[str], at: int) -> int:
    """Read how many values follow. Raises ValueError where they do not."""
    count = int(fields[at])
    if not 0 <= count < len(fields) - at:
        raise ValueError(f"it claims {count} values in a line of {len(fields)} fields")
    return count


def _pose(fields: list[str], at: int) -> Pose2D:
    return Pose2D(float(fields[at]), float(fields[at + 1]), float(fields[at + 2]))


def _is_near(pose: Pose2D | None) -> TypeGuard[Pose2D]:
    return pose is not None and all(abs(value) < FAR for value in (pose.x, pose.y, pose.theta))  # False for NaN


def _stamped(stamp: int, parent: str, child: str, pose: Pose2D) -> StampedPose:
    return StampedPose(stamp, parent, child, (pose.x, pose.y, 0.0), quaternion(pose.theta))


def _logged(line: _Line) -> int:
    """Return when a line was logged (ns): its last field; 0 where that is no time."""
    try:
        return _nanoseconds(line.fields[-1])
    except (ValueError, IndexError):
        return 0


def _rounded(value: float) -> float:
    """Return a number in the precision that a LaserScan has."""
    return float(np.float32(value))


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def _nanoseconds(text: str) -> int:
    """Return a time in seconds, as text, in ns: exact where it has nine decimals or fewer. Raises ValueError."""
    whole, _, decimals = text.partition(".")
    if whole.isdigit() and decimals.isdigit():
        return checked_stamp(int(whole) * SECOND + int(decimals[:9].ljust(9, "0")))
    nanoseconds = float(text) * SECOND
    if not math.isfinite(nanoseconds):
        raise ValueError(f"{text[:SHOWN]} is no time")
    return checked_stamp(round(nanoseconds))
