"""One session in every encoding gives the same map, the same primitives and the same report."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import prim
from prim.log.decoding.ros import decode_scan
from prim.log.messages import SCAN_TOPIC
from prim.scan import RangeOutcome
from prim.se2 import Pose2D
from tests.encodings import carmen, ros2
from tests.encodings.content import LogContent, remounted, without_truth
from tests.encodings.table import ENCODINGS, Encoding, Reduction, everything

OPTIONS: dict[str, Any] = {"mapper": "forward", "resolution": 0.02}

Replay = Callable[[Reduction, bool], prim.Result]


@pytest.fixture(scope="module")
def reduced(content: LogContent, tmp_path_factory: pytest.TempPathFactory) -> Replay:
    """The result of the session in MCAP, reduced to what an encoding carries."""

    @cache
    def replayed(carried: Reduction, truth: bool) -> prim.Result:
        session = content if truth else without_truth(content)
        return prim.replay(ros2.write_mcap(carried(session), tmp_path_factory.mktemp("reduced")), **OPTIONS)

    return replayed


@pytest.mark.parametrize("truth", [True, False], ids=["truth", "no-truth"])
@pytest.mark.parametrize("encoding", ENCODINGS, ids=lambda encoding: encoding.name)
def test_one_session_in_every_encoding_gives_the_same(
    content: LogContent, reduced: Replay, tmp_path: Path, encoding: Encoding, truth: bool
) -> None:
    path = encoding.write(content if truth else without_truth(content), tmp_path)
    result, expected = prim.replay(path, **OPTIONS), reduced(encoding.carried, truth)
    assert result.grid.frame == expected.grid.frame
    for name in ("probability", "occupied", "free", "visits"):
        assert np.array_equal(getattr(result.grid, name), getattr(expected.grid, name)), name
    assert comparable(result.report) == comparable(expected.report)
    if encoding.lossless:
        assert result.notes == expected.notes


def comparable(report: dict[str, Any]) -> dict[str, Any]:
    """Return a report without path, format and times."""
    log = {key: value for key, value in report["log"].items() if key not in ("path", "format")}
    return {**{key: value for key, value in report.items() if key != "timing"}, "log": log}


@pytest.mark.parametrize(
    ("write", "mount"),
    [
        (carmen.write_flaser, Pose2D(0.1, 0.02, 0.0)),
        (carmen.write_rlaser, Pose2D(-0.1, 0.0, math.pi)),
        (carmen.write_robotlaser, Pose2D(0.1, 0.0, 0.3)),
    ],
    ids=["flaser", "rlaser", "robotlaser"],
)
def test_carmen_tells_where_the_laser_is_on_the_robot(
    content: LogContent, tmp_path: Path, write: Callable[[LogContent, Path], Path], mount: Pose2D
) -> None:
    """By two poses of six decimals: the mount is known to micrometres, the trajectory is as good."""
    session = remounted(content, mount)
    reference = ros2.write_mcap(carmen.reduce_to_carmen(session), tmp_path)
    poses, expected = (prim.replay(path, **OPTIONS).poses for path in (write(session, tmp_path), reference))
    assert np.array_equal(poses.stamps, expected.stamps)
    assert poses.poses == pytest.approx(expected.poses, abs=2e-6)


def test_the_session_shows_what_encodings_lose(content: LogContent, reduced: Replay) -> None:
    """What was lost makes another map; else the tests above would prove little."""
    ranges = [decode_scan(message.data) for message in content.of(SCAN_TOPIC)]
    assert {int(outcome) for scan in ranges for outcome in scan.outcomes()} == set(RangeOutcome)
    whole = reduced(everything, False)
    assert (whole.primitives or whole.objects) and reduced(everything, True).errors
    for carried in {encoding.carried for encoding in ENCODINGS if not encoding.lossless}:
        assert not np.array_equal(reduced(carried, False).grid.probability, whole.grid.probability)
