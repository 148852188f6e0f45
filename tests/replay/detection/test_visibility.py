"""Which objects a map's cells and a scanner's beams can show."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from prim.errors import UsageError
from prim.scan import Scan
from recorder.session import Session
from replay.detection.visibility import Visibility
from replay.options import ReplayOptions
from replay.pipeline import Pipeline


def scan(beams: int, distance: float) -> Scan:
    return Scan(0, "laser", -math.pi, 2 * math.pi / beams, 0.1, 30.0, np.full(beams, distance, np.float32))


def note(resolution: float, sizes: tuple[float, float], beams: int = 720, distance: float = 2.0) -> str:
    seen = Visibility(resolution)
    seen.add(scan(beams, distance))
    return seen.note(sizes)


def test_nothing_is_said_where_all_can_be_seen() -> None:
    assert not note(0.01, (0.05, 2.0)) and not note(0.05, (0.5, 2.0), 1000, 20.0)
    assert not Visibility(0.01).note((0.05, 2.0)), "without a scan"


def test_what_is_less_than_five_cells_across_is_not_shown() -> None:
    said = note(0.05, (0.05, 2.0))
    assert said.startswith("objects below 0.25 m are less than 5 cells across: search for those that are shown with ")
    assert "--sizes 0.25 2" in said and "--resolution 0.01" in said


def test_what_passes_between_beams_is_hardly_met() -> None:
    """Half a degree at 24 m: beams 209 mm apart."""
    said = note(0.01, (0.05, 2.0), 720, 24.0)
    assert "below 0.1 m are missed by every other scan at its median range" in said and "--resolution" not in said
    assert not note(0.01, (0.05, 2.0), 360, 5.0)


def test_the_note_is_given_once_and_its_hint_ends_it(noisy_session: Session) -> None:
    (said,) = notes_of(noisy_session.path, ReplayOptions(resolution=0.05, sizes=(0.05, 2.0), bounds=BOUNDS))
    suggested = said.partition("search for those that are shown with ")[2].split(",")[0].split()
    assert suggested[0] == "--sizes"
    smallest, largest = map(float, suggested[1:3])
    options = ReplayOptions(resolution=0.05, sizes=(smallest, largest), bounds=BOUNDS)
    assert not notes_of(noisy_session.path, options)


BOUNDS = (-20.0, -20.0, 20.0, 20.0)
"""A map too large to be made twice."""


def notes_of(path: Path, options: ReplayOptions) -> list[str]:
    return [said for said in Pipeline(path, options).run().notes if said.startswith("objects below")]


@pytest.mark.parametrize("sizes", [(0.0, 1.0), (2.0, 1.0), (0.1, 0.15), (0.1, 1e3), (math.nan, 1.0)])
def test_impossible_sizes_are_refused_with_ones_that_are_not(sizes: tuple[float, float]) -> None:
    with pytest.raises(UsageError, match=r"such as --sizes 0\.05 2"):
        ReplayOptions(sizes=sizes)
    ReplayOptions(sizes=(0.05, 2.0))


def test_sizes_are_those_of_detection() -> None:
    with pytest.raises(UsageError, match="it excludes --no-detect"):
        ReplayOptions(sizes=(0.1, 1.0), detect=False)
