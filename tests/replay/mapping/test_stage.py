"""What is said of the rays that went into a map."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mapping.mapper import make_mapper
from prim.scan import PosedScan, Scan
from prim.se2 import Pose2D
from replay.mapping.stage import MappingStage
from replay.timing import StageTimer


def notes_of(share: float, mapper: str = "forward") -> list[str]:
    """The notes after 20 scans of a round room, a share of whose returns is missing."""
    rng = np.random.default_rng(0)
    stage = MappingStage(make_mapper(mapper, 0.02, (-1.5, -1.5, 1.5, 1.5)), None, False, 0.02, StageTimer())
    for number in range(20):
        ranges = 1 + 0.01 * rng.standard_normal(360)
        ranges[rng.random(360) < share] = math.inf
        scan = Scan(number, "laser", -math.pi, math.tau / 360, 0.05, 10.0, ranges.astype(np.float32))
        stage.update(PosedScan(number, scan, Pose2D(), [(scan, Pose2D())]))
    return stage.notes(stage.finish())


def test_dropouts_are_noted() -> None:
    (note,) = notes_of(0.1)
    assert note.startswith("about 11% of the beams returned nothing where others met a surface")


@pytest.mark.parametrize(("share", "mapper"), [(0.0, "forward"), (0.005, "forward"), (0.1, "prob"), (0.1, "det")])
def test_few_dropouts_are_not_noted(share: float, mapper: str) -> None:
    assert not notes_of(share, mapper)
