"""How likely a thing is none of the kinds, beside the others of its log."""

import math
from dataclasses import replace

import numpy as np
import pytest

from detect.refinement.options import DEFAULTS
from detect.refinement.other import Alternative, expected_share, other_log_odds
from detect.refinement.refine import Refinement
from detect.refinement.surroundings.levels import MapLevels
from prim.shapes import Kind
from tests.detect.refinement.rooms import mapped, room, scans, shape

OPTIONS = DEFAULTS.other
LOGIT = math.log(OPTIONS.prior / (1 - OPTIONS.prior))
SURE = 50.0
"""nats; odds that leave no doubt."""


def test_the_share_of_things_that_are_sure_is_laplaces_rule() -> None:
    """One count a priori for each of the five kinds and for none of them: (1 + others) / (6 + things)."""
    assert expected_share([], OPTIONS) == pytest.approx(1 / 6)
    assert expected_share([SURE] * 14 + [-SURE] * 4, OPTIONS) == pytest.approx(15 / 24)
    assert expected_share([-SURE] * 9, OPTIONS) == pytest.approx(1 / 15)


def test_things_of_which_the_rays_tell_nothing_leave_the_share_as_it_is() -> None:
    assert expected_share([LOGIT] * 40, OPTIONS) == pytest.approx(OPTIONS.prior)


def test_the_share_of_doubtful_things_is_that_of_the_mixture() -> None:
    """Unit-variance evidence of things, a third of them of no kind: the share is found although no thing is sure."""
    rng = np.random.default_rng(3)
    is_other = rng.random(4000) < 1 / 3
    x = rng.standard_normal(4000) + 1.5 * is_other
    against_the_kinds = 1.5 * x - 1.5**2 / 2  # log Bayes factor of N(1.5, 1) against N(0, 1)
    odds = against_the_kinds + LOGIT
    assert expected_share(odds.tolist(), OPTIONS) == pytest.approx(1 / 3, abs=0.03)


def test_what_is_flush_is_even_whatever_the_prior() -> None:
    flush = Alternative(np.zeros((3, 2)), 0.0, 0.01, "flush", replaces_kind=False)
    for prior in (0.05, 1 / 6, 0.9):
        assert other_log_odds([flush], 1.0, replace(OPTIONS, prior=prior)) == pytest.approx(0.0)


def test_the_share_of_a_log_is_the_prior_of_its_things(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same rays, in a log where nearly everything is of no kind: the doubt grows by the odds of the share."""
    taken = scans(room(shape(Kind.SQUARE), shape(Kind.CIRCLE, 0.5, 0.5)), 0.2)
    levels, guesses = MapLevels.of(mapped(taken)), [shape(Kind.SQUARE), shape(Kind.CIRCLE, 0.5, 0.5)]
    doubts = []
    for share in (0.01, 0.99):
        monkeypatch.setattr("detect.refinement.refine.expected_share", lambda *_, share=share: share)
        found = Refinement(levels).run(guesses, taken)
        doubts.append([one.other_probability for one in found if one is not None])
    few, many = (np.log(np.array(doubt) / (1 - np.array(doubt))) for doubt in doubts)
    assert many - few == pytest.approx(2 * math.log(99), abs=0.01)
