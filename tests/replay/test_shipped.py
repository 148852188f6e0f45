"""The weights that come with prim, on a log nobody here wrote and on recorded sessions."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest

from detect.networks.onnx_file import read_network
from detect.networks.weights import SHIPPED, load_weight_set, shipped_weights
from mapping.mapper import MAPPERS
from prim.se2 import Pose2D
from prim.shapes import Kind
from recorder.session import Session
from replay.options import ReplayOptions
from replay.pipeline import Pipeline

PILLARS = [(x, y) for x in (-0.6, 0.6) for y in (-0.6, 0.6)]

shipped = [mapper for mapper in MAPPERS if shipped_weights(mapper) is not None]


def test_weights_are_shipped_with_cards() -> None:
    """They take less than 25 MB, and each has a card with thresholds and the seed of its data."""
    assert "forward" in shipped
    files = sorted(SHIPPED.rglob("*.onnx"))
    assert sum(path.stat().st_size for path in files) < 25e6
    for mapper in shipped:
        yolo, networks = load_weight_set(SHIPPED / mapper, mapper)
        assert set(yolo.card.thresholds) == set(Kind)
        for weights in (yolo, *networks):
            assert weights.card.about["seed"]
            # nothing of the machine that exported it
            assert set(read_network(weights.path.read_bytes()).metadata) == {"prim"}


@pytest.mark.parametrize("refine", [True, False], ids=["refined", "networks alone"])
@pytest.mark.parametrize("mapper", shipped)
def test_four_pillars(real_log: Callable[[str], Path], mapper: str, refine: bool) -> None:
    """Four pillars of radius 0.15 m at (±0.6, ±0.6), and nothing else, in a log of another simulator."""
    options = ReplayOptions(mapper=mapper, laser_offset=Pose2D(-0.032, 0.0, 0.0), refine=refine)
    result = Pipeline(real_log("pillars4.mcap"), options).run().detections
    assert result is not None
    found = [detection.primitive for detection in result.detections.found]
    assert [primitive.kind for primitive in found] == [Kind.CIRCLE] * 4
    for x, y in PILLARS:
        nearest = min(found, key=lambda primitive: math.hypot(primitive.x - x, primitive.y - y))
        assert math.hypot(nearest.x - x, nearest.y - y) < (0.008 if refine else 0.025)
        assert nearest.size[0] == pytest.approx(0.15, abs=0.005 if refine else 0.015)


@pytest.mark.parametrize("mapper", shipped)
def test_a_recorded_session(quiet_session: Session, mapper: str) -> None:
    """One primitive of each kind, no noise: all are detected, to a millimetre."""
    result = Pipeline(quiet_session.path, ReplayOptions(mapper=mapper)).run().detections
    assert result is not None and result.errors is not None
    errors = result.errors
    assert errors.f1 == 1.0
    assert errors.position is not None and errors.position < 0.001
    assert errors.width is not None and errors.width < 0.001
