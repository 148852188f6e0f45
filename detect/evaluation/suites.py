"""The suites of ``prim-eval``: the paper's experiment reproduced, and the shipped weights on new sessions.

Everything is kept in one folder and made once: an interrupted run is continued.

    drawings/  start/            the weights that training starts from, in place of COCO's (detect.training.drawings)
    train-250/  test-250/        500 maps for training and 50 for thresholds; 125 other maps for tests (noise in mm)
    test-250-circle/             50 maps with one kind of primitive
    networks/prob-250/           YOLO and five CNNs by the paper's settings, as ONNX
    results/                     one file for each evaluation; those without their networks (docs/paper) are kept

Noise n has two readings, a share of 5 m as written and of 1 m as the paper's maps suggest; both are evaluated.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from detect.detector import Detector
from detect.evaluation.evaluate import evaluate_detector
from detect.evaluation.modes import RecordingMode
from detect.evaluation.paper import PAPER_KINDS, ROWS, PaperRow
from detect.evaluation.sessions import evaluate_sessions
from detect.networks.parameters import PAPER
from detect.networks.weights import DETECTOR_FILE
from detect.training.dataset import DATASET_PRESETS, DatasetOptions, load_samples, session_seeds
from detect.training.recipe import Announce, announce_duration, ensure_dataset, pretrain_yolo, train_weights
from mapping.mapper import MAPPERS
from prim import strict_json
from prim.errors import UsageError
from prim.files import ResultFormat, write_file
from prim.shapes import Kind

READINGS = {"as the maps suggest": 1.0, "as written": 5.0}
"""Standard deviation (m) of noise n = 1 under each reading."""

TRAINING = DatasetOptions(sizes=(500, 50), seed=100_000, rounded=DATASET_PRESETS["paper"].rounded)
TESTING = DatasetOptions(sizes=(0, 125), seed=150_000, rounded=DATASET_PRESETS["paper"].rounded)
SINGLE_KIND = DatasetOptions(sizes=(0, 50), seed=160_000, rounded=DATASET_PRESETS["paper"].rounded)
SINGLE_KIND_STEP = 1000
"""Distance of the seeds of two data sets of one kind."""

SHIPPED_NOISE = (0, 50, 75, 100, 250, 375, 500)
"""Range noise (mm) of warped sessions."""

OTHERS_NOISE = (50, 250, 500)
"""Range noise (mm) of the other modes of recording."""

Json = dict[str, Any]

PaperResult = tuple["Case", Json, dict[str, Json]]
"""A case, its evaluation, and its evaluations on maps with one kind by the kind's name."""


@dataclass(frozen=True)
class Case:
    """A row of the tables under one reading of noise.

    Attributes:
        reading: One of READINGS.
        row: The row.
        train_mm: Standard deviation (mm) of the noise of training maps.
        test_mm: The same of test maps.
    """

    reading: str
    row: PaperRow
    train_mm: int
    test_mm: int

    @property
    def network(self) -> str:
        """Name of the folder of its networks."""
        return f"{self.row.mapper}-{self.train_mm}"

    @property
    def test_set(self) -> str:
        """Name of its test set."""
        return f"test-{self.test_mm}"

    @property
    def single_kinds(self) -> tuple[Kind, ...]:
        """The kinds it is tested on alone too: all where training and test have the same noise, else none."""
        return PAPER_KINDS if self.train_mm == self.test_mm else ()

    def single_kind_set(self, kind: Kind) -> str:
        """Return the name of its test set with one kind."""
        return f"{self.test_set}-{kind}"


def cases() -> Iterator[Case]:
    """Yield the paper's eight rows, and those of det for the forward mapper, under both readings."""
    forward = [replace(row, mapper="forward") for row in ROWS if row.mapper == "det"]
    for reading, full in READINGS.items():
        for row in (*ROWS, *forward):
            yield Case(reading, row, round(1000 * full * row.train), round(1000 * full * row.test))


class PaperSuite:
    """The paper's experiment in a folder, which one process at a time may use.

    Attributes:
        work: The folder.
        announce: Called with lines of progress.
    """

    def __init__(self, work: Path, announce: Announce) -> None:
        self.work, self.announce = work, announce

    def results(self) -> list[PaperResult]:
        """Return the results so far; nothing is made.

        Raises:
            UsageError: There are none.
        """
        found: list[PaperResult] = []
        for case in cases():
            single = {
                kind: read_result(self.result_path(case, case.single_kind_set(kind))) for kind in case.single_kinds
            }
            whole = read_result(self.result_path(case, case.test_set))
            if whole is not None:
                by_kind = {kind.value: value for kind, value in single.items() if value is not None}
                found.append((case, whole, by_kind if len(by_kind) == len(PAPER_KINDS) else {}))
        if not found:
            raise UsageError(f"nothing has been measured in {self.work} yet")
        return found

    def run(self) -> list[PaperResult]:
        """Make what is missing; return the results of all cases.

        Raises:
            PrimError: The folder cannot be used.
        """
        found: list[PaperResult] = []
        for case in cases():
            single = {kind.value: self.evaluate(case, case.single_kind_set(kind)) for kind in case.single_kinds}
            found.append((case, self.evaluate(case, case.test_set), single))
        return found

    def evaluate(self, case: Case, test_set: str) -> Json:
        """Evaluate a case's networks, unless that is done.

        Args:
            case: The case.
            test_set: Name of the test set.

        Returns:
            The evaluation, as JSON.
        """
        path = self.result_path(case, test_set)
        stored = read_result(path)
        if stored is not None and not (self.work / "networks" / case.network).exists():
            return stored
        networks = self.networks(case)
        return evaluate_networks(path, networks, case.row.mapper, lambda: self.test_set(test_set), self.announce)

    def result_path(self, case: Case, test_set: str) -> Path:
        """Return the file of an evaluation.

        Args:
            case: The case.
            test_set: Name of the test set.

        Returns:
            Its path.
        """
        return self.work / "results" / f"{case.network}.{test_set}.json"

    def networks(self, case: Case) -> Path:
        """Return the folder of a case's networks; train them where they are missing."""
        folder = self.work / "networks" / case.network
        if (folder / DETECTOR_FILE).exists():
            return folder
        about = {"maps": TRAINING.sizes[0], "seed": TRAINING.seed, "noise_std_m": case.train_mm / 1000}
        data, start = self.training_set(case.train_mm), pretrain_yolo(self.work, self.announce)
        return train_weights(data, case.row.mapper, folder, PAPER.name, start, self.announce, about)

    def training_set(self, noise_mm: int) -> Path:
        """Return the folder of the training set of a noise (mm); make it where it is missing."""
        return self._dataset(f"train-{noise_mm}", replace(TRAINING, noise_stds=(noise_mm / 1000,)))

    def test_set(self, name: str) -> Path:
        """Return the folder of a test set by its name, ``test-NOISE[-KIND]``; make it where it is missing."""
        _, noise_mm, *kind = name.split("-")
        options = TESTING
        if kind:
            seed = SINGLE_KIND.seed + SINGLE_KIND_STEP * list(Kind).index(Kind(kind[0]))
            options = replace(SINGLE_KIND, kinds=(kind[0],), seed=seed)
        return self._dataset(name, replace(options, noise_stds=(int(noise_mm) / 1000,)))

    def _dataset(self, name: str, options: DatasetOptions) -> Path:
        return ensure_dataset(self.work / name, options, self.announce)


@dataclass(frozen=True)
class RecordingCondition:
    """Conditions under which the sessions of one row of the shipped weights' table are recorded.

    Attributes:
        name: One of RecordingMode.
        noise_mm: Standard deviation of the range noise (mm).
        options: How sessions are recorded.
        closed_world: Whether refinement takes all that stands there to be one of the kinds, or a wall.
    """

    name: str
    noise_mm: int
    options: DatasetOptions
    closed_world: bool = False

    @property
    def title(self) -> str:
        """Its name in tables."""
        return f"{self.name}, closed world" if self.closed_world else self.name

    @property
    def slug(self) -> str:
        """Its name in file names."""
        closed = "-closed-world" if self.closed_world else ""
        return f"{self.name.replace(' ', '-')}-{self.noise_mm}{closed}"


def conditions(sessions: int, closed_world: bool = False) -> Iterator[RecordingCondition]:
    """Yield the conditions that sessions are recorded under.

    Args:
        sessions: Number of sessions of each.
        closed_world: Whether refinement takes all that stands there to be one of the kinds, or a wall.

    Yields:
        All noise levels of warped sessions, and three of each other mode.
    """
    plain = DatasetOptions(sizes=(0, sessions), seed=300_000)
    for noise_mm in SHIPPED_NOISE:
        options = replace(plain, noise_stds=(noise_mm / 1000,))
        yield RecordingCondition(RecordingMode.WARPED, noise_mm, options, closed_world)
    variations: dict[RecordingMode, Json] = {
        RecordingMode.DRIVEN: {"motions": ("drive",)},
        RecordingMode.NO_WALLS: {"walled": 0.0},
        RecordingMode.FEW_RAYS: {"rays": (180,)},
        RecordingMode.MANY_RAYS: {"rays": (1000,)},
    }
    for name, change in variations.items():
        for noise_mm in OTHERS_NOISE:
            options = replace(plain, noise_stds=(noise_mm / 1000,), **change)
            yield RecordingCondition(name, noise_mm, options, closed_world)


ShippedResult = tuple[RecordingCondition, str, int, Json]
"""A condition, a mapper, the number of sessions, and the results of detect.evaluation.sessions."""


class ShippedSuite:
    """Weights of all mappers on new sessions.

    Attributes:
        work: The folder of the results.
        weights: The weights, one folder for each mapper.
        announce: Called with lines of progress.
    """

    def __init__(self, work: Path, weights: Path, announce: Announce) -> None:
        self.work, self.weights, self.announce = work, weights, announce

    def run(
        self,
        sessions: int,
        mappers: Sequence[str] = MAPPERS,
        modes: Sequence[str] = (),
        jobs: int | None = None,
        closed_world: bool = False,
    ) -> list[ShippedResult]:
        """Evaluate what is missing.

        Args:
            sessions: Number of sessions of each condition.
            mappers: Names of the mappers.
            modes: Modes of recording (RecordingMode); all where none is named.
            jobs: Number of processes; None: one for each available core.
            closed_world: Whether refinement takes all that stands there to be one of the kinds, or a wall: rows of
                their own.

        Returns:
            All results so far.

        Raises:
            UsageError: The folder holds no weights.
            OutputError: A result cannot be written.
        """
        available = [mapper for mapper in mappers if (self.weights / mapper / DETECTOR_FILE).exists()]
        if not available:
            raise UsageError(f"{self.weights} holds no weights: a folder for each mapper is wanted")
        for mapper in available:
            for condition in conditions(sessions, closed_world):
                if not modes or condition.name in modes:
                    self._evaluate(condition, sessions, mapper, jobs)
        return self.results()

    def _evaluate(self, condition: RecordingCondition, sessions: int, mapper: str, jobs: int | None) -> None:
        """Evaluate one condition, unless that was done with these weights."""
        path, weights = self._result_path(condition, sessions, mapper), self.weights / mapper
        if path.exists() and path.stat().st_mtime >= (weights / DETECTOR_FILE).stat().st_mtime:
            return
        with announce_duration(path.stem, self.announce):
            seeds = [seed for _, seed in session_seeds(condition.options)]
            result = evaluate_sessions(seeds, condition.options, mapper, weights, jobs, condition.closed_world)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, strict_json.dumps(result, indent=1))

    def results(self) -> list[ShippedResult]:
        """Return the results so far, of each condition and mapper those with most sessions.

        Raises:
            UsageError: There are none.
        """
        found = []
        for condition in (*conditions(1), *conditions(1, closed_world=True)):
            for mapper in MAPPERS:
                paths = (self.work / "results").glob(f"{condition.slug}.*.{mapper}.json")
                counts = [int(path.name.split(".")[1]) for path in paths]
                if counts:
                    value = read_result(self._result_path(condition, max(counts), mapper))
                    assert value is not None
                    found.append((condition, mapper, max(counts), value))
        if not found:
            raise UsageError(f"nothing has been measured in {self.work} yet")
        return found

    def _result_path(self, condition: RecordingCondition, sessions: int, mapper: str) -> Path:
        return self.work / "results" / f"{condition.slug}.{sessions}.{mapper}.json"


def evaluate_networks(path: Path, networks: Path, mapper: str, data: Callable[[], Path], announce: Announce) -> Json:
    """Evaluate networks on a data set, unless their result is stored and newer than they are.

    Args:
        path: File of the result.
        networks: Folder of the networks.
        mapper: Name of the mapper.
        data: Returns the folder of the data set, called where it is needed.
        announce: Called with lines of progress.

    Returns:
        The evaluation, as JSON.
    """
    if not path.exists() or path.stat().st_mtime < (networks / DETECTOR_FILE).stat().st_mtime:
        detector = Detector.load(networks, mapper)
        samples = load_samples(data(), mapper, "val")
        announce(f"evaluating {path.stem}")
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, strict_json.dumps(evaluate_detector(detector, samples).to_json(), indent=1))
    value = read_result(path)
    assert value is not None
    return value


def read_result(path: Path) -> Json | None:
    """Read a stored evaluation; None where there is none; raise UsageError where it is damaged."""
    if not path.exists():
        return None
    try:
        value: Json = strict_json.loads(path.read_bytes())
    except (OSError, ValueError) as error:
        raise UsageError(f"{path} is damaged or cannot be read: remove it to have it evaluated again") from error
    return value


RESULT = ResultFormat("a result of prim-eval", re.compile(b""))
"""Whatever lies in the folders of an evaluation is its own."""


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically.

    Args:
        path: The file.
        text: Its content.

    Raises:
        OutputError: It cannot be written.
    """
    write_file(path, text.encode(), RESULT)
