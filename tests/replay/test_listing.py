"""What a log holds, as a table and as JSON."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from prim import console
from prim.choices import PoseSourceName
from prim.log.messages import SCAN_TYPE, encode_scan
from prim.log.writer import LogWriter
from prim.scan import Scan
from recorder.session import Session
from replay.cli import app
from replay.listing import SOURCES, summarize_log
from replay.options import ReplayOptions
from replay.outputs.exports import log_stem
from replay.poses.laser_poses import STILL


def listed(*arguments: object) -> int:
    return console.run(app, "prim-replay", [str(argument) for argument in arguments])


def test_a_log_is_summarized(noisy_session: Session) -> None:
    summary = summarize_log(noisy_session.path, ReplayOptions())
    rows = {row.topic.name: row for row in summary.topics}
    assert rows["/scan"].topic.messages == noisy_session.scans
    assert rows["/scan"].frames == ("laser",)
    assert rows["/odom"].frames == ("odom > base_link",)
    assert rows["/tf_static"].frames == ("base_link > laser",)
    assert rows["/scan"].rate == pytest.approx(10, rel=0.01)
    assert rows["/scan"].lag == pytest.approx(0, abs=1e-6)
    assert (summary.scans.source, summary.poses.source) == ("/scan", "/ground_truth/pose")
    assert (summary.format, summary.notes, summary.lost) == ("MCAP", (), ())


def test_the_list_replays_nothing(noisy_session: Session, in_tmp: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert listed("--list", noisy_session.path) == 0
    out = capsys.readouterr().out
    assert list(in_tmp.iterdir()) == []
    for expected in ("/scan", "LaserScan", "base_link > laser", "/ground_truth/pose", "10.0 Hz"):
        assert expected in out


def test_the_list_as_json(noisy_session: Session, capsys: pytest.CaptureFixture[str]) -> None:
    assert listed("--list", "--json", noisy_session.path) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["schema"] == "prim-list/1"
    assert {topic["name"]: topic["holds"] for topic in found["topics"]}["/scan"] == "scans"
    assert found["poses"]["why"] == "the ground truth"


def test_a_log_of_scans_alone_is_listed_without_matching_them(
    in_tmp: Path, monkeypatch: pytest.MonkeyPatch, make_scan: Callable[..., Scan]
) -> None:
    monkeypatch.setattr("replay.localization._matched", None)
    with LogWriter(Path("a.mcap")) as log:
        log.add_topic("/scan", SCAN_TYPE)
        for second in range(1, 6):
            stamp = second * 10**9
            log.write("/scan", stamp, encode_scan(replace(make_scan(1.0, 1.0, 1.0, 1.0), stamp=stamp)))
    summary = summarize_log(Path("a.mcap"), ReplayOptions())
    assert (summary.poses.source, summary.poses.why) == ("/scan", "found by the scans alone")
    assert any("they are found by the scans alone" in note for note in summary.notes)


def test_every_source_of_poses_is_described() -> None:
    assert {*SOURCES} == {*PoseSourceName, STILL} - {PoseSourceName.AUTO}


def test_what_a_log_lacks_is_said(in_tmp: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("a.log").write_text("ODOM 0 0 0 0 0 0 1.0 host 1.0\nODOM 1 0 0 0 0 0 2.0 host 2.0\n")
    assert listed("--list", "a.log") == 0
    out = capsys.readouterr().out
    assert "CARMEN log" in out and "no LaserScan in this log" in out


def test_options_that_do_not_go_with_the_list(noisy_session: Session, capsys: pytest.CaptureFixture[str]) -> None:
    for options in (["--list", "--report", "r.json"], ["--list", "--spawn"], ["--json"]):
        assert listed(noisy_session.path, *options) == 2
        assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize(
    ("name", "stem"),
    [
        *(
            ("a.mcap", "a"),
            ("a.mcap.zst", "a"),
            ("a.b.bag", "a.b"),
            ("a.log.gz", "a"),
            ("a_0.db3", "a_0"),
            ("a", "a"),
        ),
        ("a.mcap.01234567.part", "a"),
    ],
)
def test_outputs_are_named_after_the_log(name: str, stem: str) -> None:
    assert log_stem(Path(name)) == stem
