"""Logs and reports of earlier versions: logs stay readable, and reports keep their keys."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from prim.log import open_log
from prim.log.messages import SCAN_TOPIC
from replay.ground_truth import GroundTruth
from replay.keywords import replay_options
from replay.outputs.report import report_json
from replay.pipeline import Pipeline

FIXTURES = Path(__file__).parent / "fixtures"
LOGS = sorted(FIXTURES.glob("*/*.mcap"))
REPORTS = sorted(FIXTURES.glob("*/*.report.json"))


def name_of(path: Path) -> str:
    return path.relative_to(FIXTURES).as_posix()


def keys_of(value: Any, path: str = "") -> Iterator[str]:
    """Yield the paths of all keys; the keys of all items of a list have one path."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield f"{path}/{key}"
            yield from keys_of(inner, f"{path}/{key}")
    elif isinstance(value, list):
        for inner in value:
            yield from keys_of(inner, f"{path}[]")


def of_kinds(keys: set[str]) -> set[str]:
    """Without keys that depend on which kinds were found: names of sizes."""
    return {key for key in keys if "/size/" not in key and "/std/" not in key}


def test_there_are_fixtures() -> None:
    assert LOGS and len(REPORTS) >= 3 * len(LOGS)


@pytest.mark.parametrize("path", LOGS, ids=name_of)
def test_logs_stay_readable(path: Path) -> None:
    with open_log(path) as log:
        scans = [scan for _, scan in log.decoded(log.topics[SCAN_TOPIC])]
        truth = GroundTruth.read(log)
        assert log.metadata["prim"]["version"].startswith(path.parent.name) and not log.lost
    report = json.loads(next(path.parent.glob(f"{path.stem}.*.report.json")).read_text())
    assert len(scans) == report["log"]["scans"] and sum(len(scan.ranges) for scan in scans) == report["log"]["rays"]
    assert truth is not None and truth.world.primitives


@pytest.mark.parametrize("path", REPORTS, ids=name_of)
def test_reports_keep_their_keys(path: Path) -> None:
    before = json.loads(path.read_text())
    options = replay_options(mapper=before["map"]["mapper"], pose=before["pose"]["source"])
    log = path.with_name(before["log"]["path"])
    now = json.loads(json.dumps(report_json(Pipeline(log, options).run())))
    assert now["schema"] == before["schema"]
    assert of_kinds(set(keys_of(before))) <= of_kinds(set(keys_of(now)))
    assert now["log"] == before["log"] | {"path": str(log), "format": "MCAP"}
    assert now["map"]["cells"] == before["map"]["cells"]
