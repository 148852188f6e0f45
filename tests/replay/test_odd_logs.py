"""Logs that are readable but odd: each is handled, or refused in one clear line."""

import json
import math
import sys
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer

from prim import console
from prim.log.messages import (
    ODOMETRY_TYPE,
    POINT_TYPE,
    POSE_TYPE,
    SCAN_TYPE,
    encode_odometry,
    encode_point,
    encode_pose,
    encode_scan,
)
from prim.log.writer import LogWriter
from prim.scan import Scan
from prim.se2 import Pose2D
from replay.cli import app

SECOND = 10**9
GOOD = Scan(0, "laser", -math.pi, 0.1, 0.1, 5.0, np.full(63, 1.0, dtype=np.float32))


def write(path: Path, scans: Iterable[Scan | bytes], *others: tuple[str, str, list[tuple[int, bytes]]]) -> Path:
    """Scans a second apart; the robot stands at the origin unless other topics say otherwise."""
    with LogWriter(path) as log:
        log.add_topic("/scan", SCAN_TYPE)
        count = 0
        for index, scan in enumerate(scans):
            stamp = (index + 1) * SECOND
            data = scan if isinstance(scan, bytes) else encode_scan(replace(scan, stamp=scan.stamp or stamp))
            log.write("/scan", stamp, data)
            count = index + 1
        poses = [(stamp * SECOND, encode_odometry(stamp * SECOND, Pose2D())) for stamp in range(count + 2)]
        for topic, kind, messages in others or [("/odom", ODOMETRY_TYPE, poses)]:
            log.add_topic(topic, kind)
            for stamp, data in messages:
                log.write(topic, stamp, data)
    return path


Replay = Callable[..., tuple[int, str, dict[str, Any]]]


@pytest.fixture
def replay(in_tmp: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Replay:
    """Exit code, stderr, report; warnings, which a command would not show, are errors."""
    monkeypatch.setattr(sys, "warnoptions", ["error"])

    def run(*arguments: object) -> tuple[int, str, dict[str, Any]]:
        arguments = ("--no-viewer", "--mapper", "det", "--report", "r.json", *arguments)
        code = console.run(app, "prim-replay", [str(argument) for argument in arguments])
        report = json.loads(Path("r.json").read_text()) if code in (0, 3) else {}
        return code, capsys.readouterr().err, report

    return run


def with_ranges(*ranges: float) -> Scan:
    return replace(GOOD, ranges=np.array(ranges, dtype=np.float32))


@pytest.mark.parametrize("ranges", [[math.nan] * 9, [math.inf] * 9, [-math.inf] * 9, []])
def test_a_log_without_any_return_is_noted(replay: Replay, ranges: list[float]) -> None:
    code, err, report = replay(write(Path("a.mcap"), [with_ranges(*ranges)] * 3))
    assert (code, report["log"]["scans_used"]) == (0, 3)
    assert "rays returned from a surface" in err


@pytest.mark.parametrize(
    "odd",
    [
        {"range_max": math.nan},
        {"range_max": 0.0},
        {"range_max": 0.05},
        {"range_min": math.nan},
        {"angle_min": math.nan},
        {"angle_increment": math.inf},
    ],
)
def test_a_scan_with_impossible_limits_is_left_out_and_noted(replay: Replay, odd: dict[str, float]) -> None:
    code, err, report = replay(write(Path("a.mcap"), [GOOD, replace(GOOD, **odd), GOOD]))
    assert (code, report["log"]["scans"], report["log"]["scans_used"]) == (0, 3, 2)
    assert "1 scan cannot be used, the first one 1" in err
    code, err, _ = replay(write(Path("b.mcap"), [replace(GOOD, **odd)] * 2))
    assert (code, "no scan on /scan can be used" in err, err.count("\n")) == (1, True, 1)


def test_scans_may_change_their_beams(replay: Replay) -> None:
    code, err, report = replay(write(Path("a.mcap"), [GOOD, with_ranges(1.0, 1.0), GOOD]))
    assert (code, err.count("\n"), report["log"]["rays"]) == (0, 1, 63 + 2 + 63)


def test_a_scan_that_cannot_be_decoded_is_reported(replay: Replay) -> None:
    log = write(Path("a.mcap"), [GOOD, encode_scan(GOOD)[:60], GOOD])
    code, err, _ = replay(log)
    assert (code, "message 1 of /scan cannot be decoded" in err, "--recover" in err) == (1, True, True)
    code, err, report = replay(log, "--recover")
    assert (code, report["log"]["scans_used"], report["log"]["messages_lost"]) == (3, 2, 1)
    assert "note: lost: messages of /scan that cannot be decoded" in err


def test_stamps_that_repeat_or_go_back_are_noted(replay: Replay) -> None:
    stamps = (3, 2, 2, 1)
    code, err, report = replay(write(Path("a.mcap"), [replace(GOOD, stamp=stamp * SECOND) for stamp in stamps]))
    assert "stamps go back 2 times" in err and "1 scan with the stamp of the one before" in err
    assert (code, report["log"]["scans_used"], report["log"]["duration_s"]) == (0, 4, 2.0)


def test_true_poses_of_another_type_are_ignored(replay: Replay) -> None:
    fixes = [(SECOND, encode_point(SECOND, 0, 0))]
    odometry = [(stamp * SECOND, encode_odometry(stamp * SECOND, Pose2D())) for stamp in range(5)]
    log = write(
        Path("a.mcap"), [GOOD] * 3, ("/ground_truth/pose", POINT_TYPE, fixes), ("/odom", ODOMETRY_TYPE, odometry)
    )
    code, _, report = replay(log)
    assert (code, report["pose"]["source"]) == (0, "odom")
    assert replay(log, "--pose", "truth")[0] == 1


def test_an_empty_topic_is_reported(replay: Replay) -> None:
    code, err, _ = replay(write(Path("a.mcap"), []))
    assert (code, "no messages on /scan" in err) == (1, True)
    code, err, _ = replay(write(Path("b.mcap"), [GOOD], ("/odom", ODOMETRY_TYPE, [])), "--odom-topic", "/odom")
    assert (code, "no messages on /odom" in err) == (1, True)


def test_a_gap_between_poses_is_noted(replay: Replay) -> None:
    poses = [(second * SECOND, encode_odometry(second * SECOND, Pose2D())) for second in (0, 1, 9)]
    code, err, report = replay(write(Path("a.mcap"), [GOOD] * 4, ("/odom", ODOMETRY_TYPE, poses)))
    assert (code, report["log"]["scans_used"]) == (0, 4)
    assert "3 scans lie in a gap of up to 8.0 s" in err


def test_an_invalid_world_is_noted(replay: Replay) -> None:
    with LogWriter(Path("a.mcap")) as log:
        log.add_attachment("world.json", "application/json", b"[1]", 1)
        log.add_topic("/scan", SCAN_TYPE)
        log.write("/scan", SECOND, encode_scan(replace(GOOD, stamp=SECOND)))
    code, err, report = replay("a.mcap", "--standing-still")
    assert (code, report["map"]["scores"]) == (0, None)
    assert "the map is not scored" in err


def test_true_poses_without_a_world_are_compared_with_the_poses(replay: Replay) -> None:
    from prim.log.messages import encode_pose

    true = [(s * SECOND, encode_pose(s * SECOND, Pose2D(0.3, 0.4, 0.0))) for s in range(5)]
    odometry = [(s * SECOND, encode_odometry(s * SECOND, Pose2D())) for s in range(5)]
    log = write(
        Path("a.mcap"), [GOOD] * 3, ("/ground_truth/pose", POSE_TYPE, true), ("/odom", ODOMETRY_TYPE, odometry)
    )
    code, _, report = replay(log, "--pose", "odom")
    assert (code, report["map"]["scores"]) == (0, None)
    assert report["pose"]["rmse_m"] == pytest.approx(0.5)


@pytest.mark.parametrize(
    "options",
    [
        {"use_chunking": False},
        {"repeat_channels": False, "repeat_schemas": False},
        {"use_statistics": False},
        {"use_summary_offsets": False},
        {"compression": "none"},
        {"compression": "lz4"},
        {"enable_crcs": False},
    ],
    ids=str,
)
def test_logs_of_other_writers_are_read(replay: Replay, options: dict[str, Any]) -> None:
    from mcap.writer import CompressionType

    if "compression" in options:
        options = {"compression": CompressionType[options["compression"].upper()]}
    with Path("a.mcap").open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start("ros2")
        channel = writer.register_channel("/scan", "cdr", writer.register_schema(SCAN_TYPE, "ros2msg", b""))
        for second in (1, 2, 3):
            data = encode_scan(replace(GOOD, stamp=second * SECOND))
            writer.add_message(channel, second * SECOND, data, second * SECOND)
        writer.finish()
    for recover in ([], ["--recover"]):
        code, err, report = replay("a.mcap", "--standing-still", *recover)
        assert (code, err, report["log"]["scans_used"]) == (0, "", 3)


@pytest.mark.parametrize("encoding", ["json", "cbor", "protobuf"])
def test_other_encodings_are_named(replay: Replay, encoding: str) -> None:
    with Path("a.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel("/scan", encoding, writer.register_schema(SCAN_TYPE, encoding, b""))
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()
    code, err, _ = replay("a.mcap", "--standing-still")
    assert (code, repr(encoding) in err, err.count("\n")) == (1, True, 1)


def write_chunks(path: Path, *chunks: tuple[int, ...], uncounted: int = 0) -> Path:
    """A log of scans at these seconds, chunk by chunk, whose summary counts more than there are."""
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=1 << 30)
        writer.start("ros2")
        channel = writer.register_channel("/scan", "cdr", writer.register_schema(SCAN_TYPE, "ros2msg", b""))
        for chunk in chunks:
            for second in chunk:
                writer.add_message(channel, second * SECOND, encode_scan(replace(GOOD, stamp=second * SECOND)), 0)
            writer._Writer__finalize_chunk()
        writer._Writer__statistics.channel_message_counts[channel] += uncounted
        writer.finish()
    return path


@pytest.mark.parametrize("chunks", [((1, 5, 3), (4, 2, 6)), ((2, 3, 1), (6, 4, 5)), ((4, 5, 6), (1, 2, 3))])
def test_messages_are_read_in_the_order_of_their_log_times(
    tmp_path: Path, chunks: tuple[tuple[int, ...], ...]
) -> None:
    """Chunks whose times interleave, chunks that are not sorted in themselves, chunks in the other order."""
    from prim.log import open_log

    with open_log(write_chunks(tmp_path / "a.mcap", *chunks)) as log:
        assert [message.log_time // SECOND for message in log.messages("/scan")] == [1, 2, 3, 4, 5, 6]


def test_messages_counted_in_the_summary_but_missing_are_reported(replay: Replay) -> None:
    log = write_chunks(Path("a.mcap"), (1, 2, 3), uncounted=2)
    code, err, _ = replay(log, "--standing-still")
    assert (code, "its summary counts 5 messages of channel 1, and 3 were found" in err) == (1, True)


def odometry(*poses: Pose2D) -> tuple[str, str, list[tuple[int, bytes]]]:
    stamps = [index * SECOND for index in range(len(poses))]
    return "/odom", ODOMETRY_TYPE, [(s, encode_odometry(s, pose)) for s, pose in zip(stamps, poses, strict=True)]


@pytest.mark.parametrize("value", [1e300, -1e300, math.nan, math.inf])
def test_poses_that_cannot_be_are_left_out_and_noted(replay: Replay, value: float) -> None:
    path = write(Path("a.mcap"), [GOOD] * 3, odometry(Pose2D(), Pose2D(), Pose2D(value, 0.0), Pose2D(), Pose2D()))
    code, err, report = replay(path)
    assert code == 0 and report["log"]["scans_used"] == 3
    assert "/odom: 1 poses that are not finite, beyond 1e+09 m, or without a rotation were skipped" in err


def test_reports_hold_no_number_that_is_not_finite(replay: Replay) -> None:
    """Its true poses are 1e200 m away: their errors would be infinite."""
    poses = [(s * SECOND, encode_pose(s * SECOND, Pose2D(1e200 * (s > 0), 0.0))) for s in range(5)]
    truth = "/ground_truth/pose", POSE_TYPE, poses
    path = write(Path("a.mcap"), [GOOD] * 3, odometry(*[Pose2D()] * 5), truth)
    code, err, _ = replay(path, "--pose", "odom")
    assert code == 0 and "Warning" not in err
    json.loads(Path("r.json").read_text(), parse_constant=lambda name: pytest.fail(name))


def test_rays_too_long_for_the_map_are_counted(replay: Replay) -> None:
    far = replace(GOOD, range_max=1e6, ranges=np.where(np.arange(63) < 60, 3e4, 1.0).astype(np.float32))
    code, err, _ = replay(write(Path("a.mcap"), [far] * 2))
    assert code == 0
    assert "120 of 126 rays that returned from a surface are longer than 20972 m (2097152 cells)" in err
    assert "--max-range" in err


def test_a_map_too_large_for_a_logs_ranges_is_the_logs_fault(replay: Replay) -> None:
    far = replace(GOOD, range_max=1e6, ranges=np.where(np.arange(63) % 4, 1.0, 3e3).astype(np.float32))
    path = write(Path("a.mcap"), [far])
    code, err, _ = replay(path)
    assert code == 1 and "--max-range" in err and "--resolution" in err and err.count("\n") == 1
    assert replay(path, "--max-range", "5")[0] == 0
    assert replay(path, "--bounds=-1 -1 1 1")[0] == 0
    assert replay(path, "--bounds=-3000 -3000 3000 3000")[0] == 2


@pytest.mark.parametrize("increment", [math.nan, math.inf, 1e38])
def test_times_that_cannot_be_do_not_stop_deskewing(replay: Replay, increment: float) -> None:
    """The first scan says that a sweep takes time; a later one has no such time."""
    sweeps = [replace(GOOD, time_increment=0.01), replace(GOOD, time_increment=increment)]
    turning = odometry(*[Pose2D(0.3 * s, 0.0, 0.5 * s) for s in range(5)])
    code, err, report = replay(write(Path("a.mcap"), sweeps, turning))
    assert code == 0 and report["log"]["scans_used"] == 2, err


@pytest.mark.parametrize("size", ["1e300", "1" + "0" * 400, "[" * 5000 + "]" * 5000])
def test_absurd_worlds_are_noted_and_not_scored(replay: Replay, size: str) -> None:
    path = Path("a.mcap")
    with LogWriter(path) as log:
        log.add_attachment("world.json", "application/json", f'{{"size": [{size}, 2]}}'.encode(), SECOND)
        log.add_topic("/scan", SCAN_TYPE)
        log.write("/scan", SECOND, encode_scan(replace(GOOD, stamp=SECOND)))
    code, err, report = replay(path, "--standing-still")
    assert code == 0 and "the map is not scored: its world.json" in err
    assert report["map"]["scores"] is None


@pytest.mark.parametrize("mapper", ["det", "prob", "forward"])
def test_values_of_all_kinds_are_handled(replay: Replay, mapper: str) -> None:
    """Each float of a scan and each number of a pose in turn; warnings of numpy are errors in tests."""
    odd = [math.nan, math.inf, -math.inf, 1e36, -1e36, 1e-38, 0.0]
    names = ["angle_min", "angle_increment", "range_min", "range_max", "time_increment", "scan_time"]
    scans = [replace(GOOD, **{name: value}) for name in names for value in odd]
    scans += [with_ranges(*odd * 9) for _ in range(2)]
    path = write(Path("a.mcap"), [GOOD, *scans, GOOD])
    for options in ([], ["--match-scans"], ["--no-deskew", "--max-range", "1e300"]):
        code, err, _ = replay(path, "--bounds=-2 -2 2 2", "--mapper", mapper, "--resolution", "0.1", *options)
        assert code == 0 and "Warning" not in err, err
