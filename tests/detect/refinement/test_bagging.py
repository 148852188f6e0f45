"""Scores where scans disagree: the mean of the posteriors by all rays and by parts of the scans."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from detect.refinement.bagging import PartialPosterior, partial_posteriors
from detect.refinement.candidates import Candidate, fit_candidates
from detect.refinement.likelihood.rays import collect_rays
from detect.refinement.likelihood.sensor_model import BeamModel, DistanceMap
from detect.refinement.options import DEFAULTS
from detect.refinement.refine import RefinedPrimitive, Refinement
from detect.refinement.surroundings.levels import MapLevels
from detect.refinement.surroundings.map_cells import MapCells
from prim.se2 import Pose2D
from prim.shapes import Kind
from tests.detect.refinement.rooms import mapped, room, scans, shape

EVEN = {kind: 1 / len(Kind) for kind in Kind}
SURE = dict.fromkeys(Kind, 0.0) | {Kind.SQUARE: 1.0}


def result(other: float) -> RefinedPrimitive:
    return RefinedPrimitive(shape(Kind.SQUARE), {}, np.eye(4), SURE, 100.0, 0.0, 100, 1.0, other_probability=other)


def test_the_average_is_that_of_joint_probabilities() -> None:
    averaged = result(0.0).averaged([PartialPosterior(SURE, 0.0), PartialPosterior(EVEN, 0.5)])
    assert averaged.other_probability == pytest.approx(1 / 6)
    assert averaged.score == pytest.approx((1 + 1 + 0.5 / 5) / 3)
    assert sum(averaged.kind_probabilities.values()) == pytest.approx(1.0)
    assert averaged.primitive == result(0.0).primitive


def test_without_parts_or_doubt_nothing_changes() -> None:
    assert result(0.25).averaged([]).score == pytest.approx(result(0.25).score)
    assert result(1.0).averaged([PartialPosterior(SURE, 1.0)]).score == 0.0


def test_parts_of_the_scans_of_a_square_are_sure_that_it_is_one() -> None:
    world = room(shape(Kind.SQUARE))
    taken = scans(world, 0.01)
    (bundle,), span, _ = collect_rays(taken, [world.primitives[0]], 0.05)
    cells = MapCells.of(mapped(taken))
    sensor = BeamModel.create(0.01, span)
    candidate = Candidate(world.primitives[0], bundle, cells)
    candidate.background = DistanceMap.of(cells.without(world.primitives, 0.02), cells.frame).background(bundle)
    with ThreadPoolExecutor(1) as pool:
        fit_candidates(pool, [candidate], [True], sensor)
    parts = partial_posteriors(candidate, [candidate], [], sensor, DEFAULTS.other)
    assert len(parts) == DEFAULTS.other.bagged_parts
    for part in parts:
        assert part.kind_probabilities[Kind.SQUARE] > 0.9 and part.other_probability < 0.1
    one_scan = bundle.scan == bundle.scan[0]
    candidate.keep_rays(one_scan)
    assert partial_posteriors(candidate, [candidate], [], sensor, DEFAULTS.other) == []


@pytest.mark.parametrize(("pose_std", "asked"), [(0.0, False), (0.02, True)])
def test_parts_are_asked_where_poses_are_off(monkeypatch: pytest.MonkeyPatch, pose_std: float, asked: bool) -> None:
    """A range noise of 5 mm, poses off by 20 mm: then a score is the mean of three."""
    rng = np.random.default_rng(1)
    taken = [
        (scan, Pose2D(pose.x + rng.normal(0, pose_std), pose.y + rng.normal(0, pose_std), pose.theta))
        for scan, pose in scans(room(shape(Kind.SQUARE)), 0.005)
    ]
    parts = [PartialPosterior(EVEN, 0.0)] * 2
    monkeypatch.setattr("detect.refinement.refine.partial_posteriors", lambda *_: parts)
    (found,) = Refinement(MapLevels.of(mapped(taken)), noise_std=0.005).run([shape(Kind.SQUARE)], taken)
    assert found is not None
    assert found.score <= (1 + 0.2 + 0.2) / 3 if asked else found.score > 0.95
