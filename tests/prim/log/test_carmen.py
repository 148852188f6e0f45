"""CARMEN's logs as robots and editors leave them."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from prim.errors import LogReadError
from prim.log import open_log
from prim.log.decoding.codecs import Content
from prim.log.source import LogSource

RANGES = "3 1.0 2.0 3.0"
ODOM = [f"ODOM {k / 10} 0 0 0 0 0 {100 + k / 10:.1f} host {k / 10}" for k in range(20)]


def flaser(pose: str = "{x} 0 0 {x} 0 0", name: str = "FLASER") -> Iterator[str]:
    for k in range(20):
        yield f"{name} {RANGES} {pose.format(x=k / 10)} {100 + k / 10:.1f} host {k / 10}"


def robotlaser() -> Iterator[str]:
    for k in range(20):
        head = f"ROBOTLASER1 0 -1.57 3.14 1.57 80 0.01 0 {RANGES} 0"
        yield f"{head} {k / 10} 0 0 {k / 10} 0 0 0 0 0.4 0.3 1e6 {100 + k / 10:.1f} host {k / 10}"


def written(path: Path, lines: Iterator[str] | list[str], end: str = "\n") -> Path:
    path.write_bytes(end.join([*lines, ""]).encode())
    return path


def interleaved(*kinds: Iterator[str]) -> list[str]:
    return [line for lines in zip(*kinds, strict=True) for line in lines]


def names(log: LogSource, content: Content) -> list[str]:
    return [topic.name for topic in log.holding(content)]


def scans(path: Path, recover: bool = False) -> int:
    with open_log(path, recover) as log:
        return len(list(log.numbered(*log.holding(Content.SCAN))))


@pytest.mark.parametrize("end", ["\n", "\r\n", " \n\n"])
@pytest.mark.parametrize("start", ["", "\ufeff", "# CARMEN Logfile\n", "\ufeff# CARMEN Logfile\n", "\n  "])
def test_line_ends_and_what_editors_add_do_not_matter(tmp_path: Path, start: str, end: str) -> None:
    lines = [*flaser()]
    assert scans(written(tmp_path / "a", [start + lines[0], *lines[1:]], end)) == 20


def test_poses_that_all_are_the_same_are_none(tmp_path: Path) -> None:
    path = written(tmp_path / "a", interleaved(iter(ODOM), flaser("0 0 0 0 0 0")))
    with open_log(path) as log:
        assert names(log, Content.ODOMETRY) == ["ODOM"] and not log.holding(Content.TRANSFORMS, Content.POSE)
        assert len(log.notes) == 1 and "those of ODOM are used" in log.notes[0]


def test_poses_of_a_robot_at_rest_remain(tmp_path: Path) -> None:
    rest = ["ODOM 0 0 0 0 0 0 100.0 host 0"] * 20
    with open_log(written(tmp_path / "a", interleaved(iter(rest), flaser("0 0 0 0 0 0")))) as log:
        assert names(log, Content.ODOMETRY) == ["robot_poses"] and not log.notes


@pytest.mark.parametrize("order", [1, -1])
def test_scans_that_are_written_twice_are_read_once(tmp_path: Path, order: int) -> None:
    kinds = (flaser(), robotlaser(), flaser(name="RLASER"))[::order]
    with open_log(written(tmp_path / "a", interleaved(*kinds))) as log:
        assert names(log, Content.SCAN) == ["RLASER", "ROBOTLASER1"]
        assert log.notes == ["FLASER has the scans of ROBOTLASER1 once more: they are not used"]


def test_lasers_of_other_times_are_others(tmp_path: Path) -> None:
    later = (line.replace(" 10", " 20") for line in robotlaser())
    with open_log(written(tmp_path / "a", interleaved(flaser(), later))) as log:
        assert names(log, Content.SCAN) == ["FLASER", "ROBOTLASER1"] and not log.notes


@pytest.mark.parametrize(
    "damage", ["FLASER 3 1.0", "FLASER abc", "FLASER 99 1 2 3", "FLASER", "FLASER 3 1 x 3 0 0 0 0"]
)
def test_a_damaged_line_is_a_loss(tmp_path: Path, damage: str) -> None:
    path = written(tmp_path / "a", [*flaser(), damage, "\1\x80 garbage", *ODOM])
    with pytest.raises(LogReadError, match=r"message 20 of FLASER cannot be decoded: .*--recover"):
        scans(path)
    assert scans(path, recover=True) == 20
