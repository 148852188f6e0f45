"""The suites of ``prim-eval``: the paper's experiment made again, and the shipped weights on fresh sessions.

Everything lies in one folder and is made once: an interrupted run goes on where it stopped.

    drawings/  start/            what training begins from, in the place of COCO's weights (detect.training.drawings)
    train-250/  test-250/        500 maps to train on and 50 to choose thresholds on; 125 other maps (noise in mm)
    test-250-circle/             50 maps with one kind of primitive
    networks/prob-250/           YOLO and five CNNs by the paper's settings, as ONNX
    results/                     one evaluation each; what is kept without its networks (docs/paper) stands

Noise has two readings (DESIGN: n is a share of 5 m as written, of 1 m as the paper's maps look); both are done.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from detect.detector import Detector
from detect.evaluation.evaluate import evaluate
from detect.evaluation.paper import ROWS, Row
from detect.evaluation.sessions import trials
from detect.networks.parameters import PAPER
from detect.networks.weights import DETECTOR
from detect.training.dataset import PRESETS, SetOptions, samples
from detect.training.dataset import sessions as sessions_of
from detect.training.recipe import Say, make_set, make_start, make_weights, timed
from mapping.mapper import MAPPERS
from prim.errors import OutputError, UsageError
from prim.shapes import Kind

READINGS = {"as the maps suggest": 1.0, "as written": 5.0}
"""The standard deviation (m) of noise 1.0 under each reading."""

TRAINING = SetOptions(sizes=(500, 50), seed=100_000, rounded=PRESETS["paper"].rounded)
TESTING = SetOptions(sizes=(0, 125), seed=150_000, rounded=PRESETS["paper"].rounded)
SINGLE = SetOptions(sizes=(0, 50), seed=160_000, rounded=PRESETS["paper"].rounded)
SINGLE_STEP = 1000
"""Sets of one kind have seeds this far apart."""


SHIPPED_NOISE = (0, 50, 75, 100, 250, 375, 500)
OTHERS_NOISE = (50, 250, 500)


@dataclass(frozen=True)
class Case:
    """One row of the tables under one reading; noise as millimetres of standard deviation."""

    reading: str
    row: Row
    train_mm: int
    test_mm: int

    @property
    def network(self) -> str:
        """The folder of its networks."""
        return f"{self.row.mapper}-{self.train_mm}"

    @property
    def test(self) -> str:
        """Its test set."""
        return f"test-{self.test_mm}"

    @property
    def alone(self) -> tuple[Kind, ...]:
        """The kinds it is tested on alone as well: all, where it was trained on the noise that it is tested on."""
        return tuple(Kind) if self.train_mm == self.test_mm else ()


def cases() -> Iterator[Case]:
    """The paper's eight rows, and the same for the forward mapper, under both readings."""
    forward = [replace(row, mapper="forward") for row in ROWS if row.mapper == "det"]
    for reading, full in READINGS.items():
        for row in (*ROWS, *forward):
            yield Case(reading, row, round(1000 * full * row.train), round(1000 * full * row.test))


def single(kind: Kind) -> str:
    """What is added to a test set's name where it holds one kind alone."""
    return f"-{kind}"


class Suite:
    """The experiment in a folder; ``say`` is told what is being done. One at a time works in a folder."""

    def __init__(self, work: Path, say: Say) -> None:
        self.work, self.say = work, say

    def measured(self) -> list[tuple[Case, dict[str, Any], dict[str, dict[str, Any]]]]:
        """What :meth:`run` has measured so far; makes nothing. Raises UsageError where that is nothing."""
        found = []
        for case in cases():
            alone = {kind: read(self.result(case, case.test + single(kind))) for kind in case.alone}
            whole = read(self.result(case, case.test))
            if whole is not None:
                each = {kind.value: value for kind, value in alone.items() if value is not None}
                found.append((case, whole, each if len(each) == len(Kind) else {}))
        if not found:
            raise UsageError(f"nothing has been measured in {self.work} yet")
        return found

    def run(self) -> list[tuple[Case, dict[str, Any], dict[str, dict[str, Any]]]]:
        """Makes what is missing; returns each case with its evaluation, and those on maps with one kind alone.

        Raises PrimError where the folder cannot be used.
        """
        found = []
        for case in cases():
            alone = {kind.value: self.evaluated(case, case.test + single(kind)) for kind in case.alone}
            found.append((case, self.evaluated(case, case.test), alone))
        return found

    def evaluated(self, case: Case, test: str) -> dict[str, Any]:
        """The evaluation of a case's networks on a set."""
        path = self.result(case, test)
        kept = read(path)
        if kept is not None and not (self.work / "networks" / case.network).exists():
            return kept
        return evaluated(path, self.networks(case), case.row.mapper, lambda: self.tests(test), self.say)

    def result(self, case: Case, test: str) -> Path:
        """Where an evaluation is kept."""
        return self.work / "results" / f"{case.network}.{test}.json"

    def networks(self, case: Case) -> Path:
        """The folder of a case's networks, trained."""
        folder = self.work / "networks" / case.network
        if (folder / DETECTOR).exists():
            return folder
        about = {"maps": TRAINING.sizes[0], "seed": TRAINING.seed, "noise_std_m": case.train_mm / 1000}
        data, start = self.training(case.train_mm), make_start(self.work, self.say)
        return make_weights(data, case.row.mapper, folder, PAPER.name, start, self.say, about)

    def training(self, noise_mm: int) -> Path:
        """A set to train on."""
        return self._made(f"train-{noise_mm}", replace(TRAINING, noise_stds=(noise_mm / 1000,)))

    def tests(self, name: str) -> Path:
        """A set to test on, by its name."""
        _, noise_mm, *kind = name.split("-")
        options = TESTING
        if kind:
            seed = SINGLE.seed + SINGLE_STEP * list(Kind).index(Kind(kind[0]))
            options = replace(SINGLE, kinds=(kind[0],), seed=seed)
        return self._made(name, replace(options, noise_stds=(int(noise_mm) / 1000,)))

    def _made(self, name: str, options: SetOptions) -> Path:
        return make_set(self.work / name, options, self.say)


@dataclass(frozen=True)
class Condition:
    """How the sessions of one row of the shipped weights' table are recorded."""

    name: str
    noise_mm: int
    options: SetOptions

    @property
    def set(self) -> str:
        """Its folder."""
        return f"{self.name.replace(' ', '-')}-{self.noise_mm}"


WAYS = ("warped", "driven", "no walls", "180 rays", "1000 rays")
"""The ways of recording."""


def conditions(sessions: int) -> Iterator[Condition]:
    """All noise levels on warped sessions, and other ways of recording at three of them."""
    plain = SetOptions(sizes=(0, sessions), seed=300_000)
    for noise_mm in SHIPPED_NOISE:
        yield Condition(WAYS[0], noise_mm, replace(plain, noise_stds=(noise_mm / 1000,)))
    changes: tuple[dict[str, Any], ...] = (
        {"motions": ("drive",)},
        {"walled": 0.0},
        {"rays": (180,)},
        {"rays": (1000,)},
    )
    for name, change in zip(WAYS[1:], changes, strict=True):
        for noise_mm in OTHERS_NOISE:
            yield Condition(name, noise_mm, replace(plain, noise_stds=(noise_mm / 1000,), **change))


Measured = tuple[Condition, str, int, dict[str, Any]]
"""A condition, a mapper, how many sessions were measured, and what detect.evaluation.sessions says of them."""


class ShippedSuite:
    """The weights of a folder, one inside it for each mapper, on fresh sessions; ``say`` is told what is done."""

    def __init__(self, work: Path, weights: Path, say: Say) -> None:
        self.work, self.weights, self.say = work, weights, say

    def run(self, sessions: int, mappers: Sequence[str] = MAPPERS, ways: Sequence[str] = ()) -> list[Measured]:
        """Measures what is missing of so many sessions for each of the ``mappers`` and each of the ``ways`` of
        recording (all, where none is named); returns all that has been measured.

        Raises UsageError where the folder holds no weights, OutputError where a result cannot be written.
        """
        able = [mapper for mapper in mappers if (self.weights / mapper / DETECTOR).exists()]
        if not able:
            raise UsageError(f"{self.weights} holds no weights: a folder for each mapper is wanted")
        for mapper in able:
            for condition in conditions(sessions):
                if not ways or condition.name in ways:
                    self._measure(condition, sessions, mapper)
        return self.measured()

    def _measure(self, condition: Condition, sessions: int, mapper: str) -> None:
        """Measures one row, unless it was measured with these weights before."""
        path, weights = self._result(condition, sessions, mapper), self.weights / mapper
        if path.exists() and path.stat().st_mtime >= (weights / DETECTOR).stat().st_mtime:
            return
        with timed(path.stem, self.say):
            seeds = [seed for _, seed in sessions_of(condition.options)]
            found = trials(seeds, condition.options, mapper, weights)
        path.parent.mkdir(parents=True, exist_ok=True)
        write(path, json.dumps(found, indent=1))

    def measured(self) -> list[Measured]:
        """What has been measured so far, of each row with most sessions. Raises UsageError where that is nothing."""
        found = []
        for condition in conditions(1):
            for mapper in MAPPERS:
                paths = (self.work / "results").glob(f"{condition.set}.*.{mapper}.json")
                counts = [int(path.name.split(".")[1]) for path in paths]
                if counts:
                    value = read(self._result(condition, max(counts), mapper))
                    assert value is not None
                    found.append((condition, mapper, max(counts), value))
        if not found:
            raise UsageError(f"nothing has been measured in {self.work} yet")
        return found

    def _result(self, condition: Condition, sessions: int, mapper: str) -> Path:
        """Where a row is kept."""
        return self.work / "results" / f"{condition.set}.{sessions}.{mapper}.json"


def evaluated(path: Path, networks: Path, mapper: str, data: Callable[[], Path], say: Say) -> dict[str, Any]:
    """The evaluation of networks on a set, kept at ``path``; made again where the networks are newer."""
    if not path.exists() or path.stat().st_mtime < (networks / DETECTOR).stat().st_mtime:
        detector = Detector.load(networks, mapper)
        chosen = samples(data(), mapper, "val")
        say(f"evaluating {path.stem}")
        path.parent.mkdir(parents=True, exist_ok=True)
        write(path, json.dumps(evaluate(detector, chosen).to_json(), indent=1))
    value = read(path)
    assert value is not None
    return value


def read(path: Path) -> dict[str, Any] | None:
    """An evaluation that is kept; None where there is none."""
    if not path.exists():
        return None
    value: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return value


def write(path: Path, text: str) -> None:
    """Writes a file; whole, or not at all. Raises OutputError where it cannot."""
    part = path.with_name(path.name + ".part")
    try:
        part.write_text(text, encoding="utf-8")
        part.replace(path)
    except OSError as error:
        raise OutputError(path, error) from error
