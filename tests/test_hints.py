"""What all other commands and the API suggest is run as well; and no hint of the sources is left out."""

from __future__ import annotations

import ast
import pickle
import re
import shlex
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import pytest

import prim
from detect import cli as detect_cli
from detect.training.dataset import image_style, load_samples
from mapping.grid import GridFrame
from prim import console
from recorder.cli import app as record
from recorder.motion import ExplorerOptions
from recorder.sensors import Lidar
from recorder.session import SessionOptions, record_session
from recorder.world import WorldOptions
from replay.cli import app as replay
from replay.intervals import DETECTED_CELLS, MAP_SNAPSHOT_CELLS, Interval, detection_interval, snapshot_interval
from replay.options import ReplayOptions
from tests import hints
from tests.replay.test_hints import SITUATIONS, TWO, turning, write

Run = Callable[..., tuple[int, str]]

COMMANDS = {
    "prim-replay": replay,
    "prim-record": record,
    "prim-train": detect_cli.train,
    "prim-eval": detect_cli.evaluation,
}


@pytest.fixture
def run(in_tmp: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Run:
    """Exit code and all that is printed by a command, which is given as words."""
    monkeypatch.setattr(sys, "warnoptions", ["error"])

    def call(name: str, *arguments: str) -> tuple[int, str]:
        code = console.run(COMMANDS[name], name, arguments)
        printed = capsys.readouterr()
        return code, printed.out + printed.err

    return call


def suggested_command(text: str) -> list[str]:
    """The command of prim at the end of a text."""
    return shlex.split(text[text.index("prim-") :])


@pytest.mark.parametrize("command", COMMANDS)
def test_the_help_that_is_suggested_is_there(run: Run, command: str) -> None:
    code, printed = run(command, "--no-such-option")
    suggestion = hints.find("(try: ", printed)
    assert code == 2 and suggestion
    code, printed = run(*suggested_command(suggestion.rstrip(")")))
    assert code == 0 and "Usage: " in printed


class Recording(NamedTuple):
    """Arguments of prim-record with which it suggests something."""

    hint: str
    arguments: str
    code: int = 2


QUICK = "a.mcap --rays 20 "
RECORDINGS = {
    "no room to drive": Recording(
        "the robot finds no room to drive: give", QUICK + "--motion drive --duration 1 --per-kind 0 --arena 0.1 0.1"
    ),
    "crowded": Recording(
        "the robot finds no room to drive: give",
        QUICK + "--motion drive --duration 1 --per-kind 1 --arena 0.4 0.4 --kinds square",
    ),
    "many primitives": Recording("do not fit on", QUICK + "--per-kind 40 --stops 2 2"),
    "a small floor": Recording("do not fit on", QUICK + "--per-kind 1 --stops 2 2 --arena 0.1 3"),
    "much clutter": Recording("do not fit on", QUICK + "--per-kind 0 --clutter 100 --stops 2 2"),
    "sizes the other way": Recording(
        "give the smaller one first:", QUICK + "--per-kind 0-1 --stops 2 2 --sizes 0.3 0.1"
    ),
    "large things on a small floor": Recording("do not fit on", QUICK + "--per-kind 1 --stops 2 2 --sizes 1 2"),
    "a small room": Recording("finds no place on", QUICK + "--per-kind 0 --room furniture --arena 0.1 0.1"),
    "a crowded room": Recording("do not fit on", QUICK + "--per-kind 4 --room L --arena 1 1"),
}


@pytest.mark.parametrize("name", RECORDINGS)
def test_what_is_suggested_for_a_recording_helps(run: Run, name: str) -> None:
    recording = RECORDINGS[name]
    code, printed = run("prim-record", *recording.arguments.split())
    suggestion = hints.find(recording.hint, printed)
    assert code == recording.code and suggestion, printed
    code, printed = run("prim-record", *recording.arguments.split(), *hints.suggested_option(suggestion, record))
    assert code == 0 and not hints.find(recording.hint, printed), printed


def test_a_floor_that_is_too_large_to_drive_on_is_made_smaller(in_tmp: Path) -> None:
    options = SessionOptions(
        motion="drive",
        duration=1,
        lidar=Lidar(rays=20),
        world=WorldOptions(size=(30, 0.5), per_kind=(0, 0)),
        explorer=ExplorerOptions(max_cells=3000),
    )
    with pytest.raises(prim.UsageError) as error:
        record_session(Path("a.mcap"), options)
    suggestion = hints.find("m is too large to drive on: give", str(error.value))
    width, height = map(float, hints.suggested_option(suggestion, record)[1:])
    assert height == 0.5 and 2 < width < 30
    record_session(Path("a.mcap"), replace(options, world=replace(options.world, size=(width, height))))


def test_a_recording_names_the_form_of_a_range_and_the_command_that_replays_it(run: Run) -> None:
    code, printed = run("prim-record", "my log.mcap", "--per-kind", "few", "--stops", "3", "3")
    suggestion = hints.find("a range such as {}", printed)
    assert code == 2 and suggestion
    _, printed = run("prim-record", "my log.mcap", "--per-kind", suggestion.split()[-1], "--stops", "3", "3")
    command = suggested_command(hints.find("replay it: ", printed))
    assert command[1:] == ["my log.mcap"]
    assert run(*command, "--no-viewer", "--no-detect")[0] == 0


def test_sets_to_train_on_are_made_by_the_commands_that_are_named(run: Run) -> None:
    def without_set(folder: str, mapper: str) -> list[str]:
        with pytest.raises(prim.UsageError) as error:
            load_samples(Path(folder), mapper, "val")
        return suggested_command(hints.find("make one with: prim-train", str(error.value)))

    for mapper, small in {"det": ["--maps", "1", "1"], "drawings": ["--images", "1", "1"]}.items():
        command = without_set(f"a {mapper} set", mapper)
        assert run(*command, *small, "--quiet") == (0, "")
        assert (Path(f"a {mapper} set") / f"{mapper}.yaml").exists()
    assert load_samples(Path("a det set"), "det", "val")
    command = without_set("a det set", "prob")  # whose folder holds another one
    assert run(*command, "--maps", "1", "1", "--quiet") == (0, "") and load_samples(Path(command[2]), "prob", "val")
    with pytest.raises(prim.UsageError, match="make one with: prim-train dataset none --mapper det"):
        image_style(Path("none"), "det")


def test_the_export_of_a_pickle_is_a_command_that_can_be_given(run: Run) -> None:
    Path("my yolo.pt").write_bytes(pickle.dumps({}))
    log = write("a.mcap")
    code, printed = run("prim-replay", log, "--no-viewer", "--weights", "my yolo.pt")
    command = suggested_command(hints.find("make an ONNX file of it with: ", printed))
    assert code == 1 and command[2:4] == ["my yolo.pt", "my yolo.onnx"]
    code, printed = run(*command)
    assert code == 2 and ("name it with --set" in printed or "training needs" in printed), (
        "its options are understood"
    )


def test_intervals_that_are_suggested_are_shorter() -> None:
    choices: list[tuple[Callable[[ReplayOptions, int, int], Interval], str, int]] = [
        (snapshot_interval, "map_every", MAP_SNAPSHOT_CELLS),
        (partial(detection_interval, is_shown=True), "detect_every", DETECTED_CELLS),
    ]
    for interval, name, cells in choices:
        for share in (1 / 3, 2.0):
            found = interval(ReplayOptions(), 700, round(cells * share))
            option, value = hints.suggested_option(hints.find("more often with", found.note), replay)
            assert option == "--" + name.replace("_", "-") and int(value) < (found.scans or 701)
            assert not interval(ReplayOptions(**{name: int(value)}), 700, round(cells * share)).note


ONE = {"scan_topic": "/front"}
CALLS: dict[str, tuple[dict[str, object], str]] = {
    "scan_topic": ({}, r"choose one with scan_topic ([^ ,]+)"),
    "clock": ({"clock": "sun", **ONE}, r"clock is 'sun': choose from (\w+)"),
    "pose": ({"pose": "best", **ONE}, r"pose is 'best': choose from (\w+)"),
    "sweep": ({"sweep": "up", **ONE}, r"sweep is 'up': choose from (\w+)"),
    "mapper": ({"mapper": "magic", **ONE}, r"no mapper 'magic': choose from (\w+)"),
    "sensor_model": ({"sensor_model": "x", "mapper": "prob", **ONE}, r"no sensor model 'x': choose from (\w+)"),
}
"""By the parameter that is suggested: parameters of a replay of two scanners, and the message with its value."""


@pytest.mark.parametrize("name", CALLS)
def test_what_the_api_suggests_helps(name: str, in_tmp: Path) -> None:
    given, pattern = CALLS[name]
    log = write("a.mcap", TWO)
    fixed: dict[str, object] = {"detect": False, "resolution": 0.05}
    with pytest.raises(prim.PrimError) as error:
        prim.replay(log, **fixed, **given)  # type: ignore[arg-type]
    match = re.search(pattern, str(error.value))
    assert match and "--" not in str(error.value), error.value
    prim.replay(log, **fixed | given | {name: match[1]})  # type: ignore[arg-type]


def test_keywords_that_are_meant_are_taken(in_tmp: Path) -> None:
    log = write("a.mcap")
    fixed = {"resolution": 0.05, "detect": False}
    with pytest.raises(prim.UsageError) as error:
        prim.replay(log, stand_still=True, **fixed)  # type: ignore[call-arg]
    match = re.search(r"did you mean (\w+)\?", str(error.value))
    assert match and prim.replay(log, **fixed, **{match[1]: True})  # type: ignore[arg-type]
    with pytest.raises(prim.UsageError) as error:
        prim.replay(log, no_refine=True)  # type: ignore[call-arg]
    match = re.search(r"give (\w+)=False", str(error.value))
    assert match and prim.replay(log, resolution=0.05, **{match[1]: False})  # type: ignore[arg-type]


def test_the_offset_that_the_api_suggests_is_in_radians(in_tmp: Path) -> None:
    from tests.replay.poses.test_mount_estimation import OFF

    log = turning()[0]
    found = prim.replay(log, detect=False, resolution=0.05)
    suggestion = next(match for note in found.notes if (match := re.search(r"use it: laser_offset (\(.*\))", note)))
    offset = ast.literal_eval(suggestion[1])
    assert offset == pytest.approx((OFF.x, OFF.y, OFF.theta), abs=0.02)
    better = prim.replay(log, detect=False, resolution=0.05, laser_offset=offset)
    assert not any("use it" in note for note in better.notes)
    assert any("give laser_offset (x, y, radians)" in note for note in found.notes)


def test_a_model_of_noise_takes_the_noise_that_it_needs() -> None:
    with pytest.raises(prim.UsageError, match="needs noise_std"):
        prim.make_mapper("prob", sensor_model="gaussian")
    assert prim.make_mapper("prob", sensor_model="gaussian", noise_std=0.05)


def test_the_resolution_of_which_a_map_has_few_enough_cells() -> None:
    with pytest.raises(prim.UsageError) as error:
        GridFrame.covering((0, 0, 900, 700), 0.02)
    GridFrame.covering((0, 0, 900, 700), float(hints.suggested_option(str(error.value), replay)[1]))


USERS = "what the user alone knows or chooses"
TRUST = "whether a file is to be trusted; tests/detect/test_cli.py gives --trust"
ABOVE = "given by a test above"
PART = "a part of a hint, or what stands before one"
WINDOW = "opens a window, which needs a display"
OF_TYPES = "a type that a parameter has: tests/replay/test_api.py"

NOT_IN_TABLES = {
    "--debug shows the traceback": "tests/prim/test_console.py",
    "read it without sorting all of them with --recover": "tests/prim/log/test_mcap_damage.py",
    "a larger --resolution or a part of the log takes less": "how much memory there is",
    "(try: {} --help)": ABOVE,
    "m is too large to drive on: give": ABOVE,
    "such as --sizes 0.05 2": "tests/replay/detection/test_visibility.py",
    "search for those that are shown with --sizes": "tests/replay/detection/test_visibility.py",
    ", or finer cells with --resolution": "tests/replay/detection/test_visibility.py",
    "which is used; to fuse give --pose fused": "tests/replay/test_case_logs.py",
    "once they are matched: try --match-scans": "tests/replay/poses/test_tracking.py",
    "change to another one": USERS,
    "choose another place": USERS,
    "give the output another name": USERS,
    "replay the logs one by one, each with names of its own": USERS,
    "give an MCAP log, a ROS 1 or ROS 2 bag": USERS,
    "give a log": USERS,
    "save it to a file": USERS,
    "open it with: rerun": WINDOW,
    "open:  rerun": WINDOW,
    "start one there with: rerun": WINDOW,
    "convert it with: rosbag fix": "a program of ROS 1",
    "unpack its chunks with: rosbag decompress": "a program of ROS 1",
    "if you trust it, {}": "tests/prim/log/test_hostile_logs.py",
    " --long=31": "tests/prim/log/test_hostile_logs.py",
    "give that as a transform": "a change of what writes the log",
    ": give {}=False": ABOVE,
    ": did you mean {}?": ABOVE,
    "give a path, as text or as a Path": OF_TYPES,
    "give a map, such as result.grid": OF_TYPES,
    "give a list, such as result.primitives": OF_TYPES,
    "give prim.Primitive or what a replay found": OF_TYPES,
    "give a function of two numbers": OF_TYPES,
    "a picture is saved as PNG: give a name that ends in .png": OF_TYPES,
    "--force replaces them": "of a replay that is interrupted: as «or --force to replace it»",
    "give --weights, or --no-detect": "no mapper is without weights",
    "more often with --map-every {}": ABOVE,
    "more often with --detect-every {}": ABOVE,
    "given by --scan-topic": "says what was given",
    "is {}: choose from {}": ABOVE,
    "there is no mapper {}: choose from {}": ABOVE,
    "there is no sensor model {}: choose from {}": ABOVE,
    "there is no preset {}: choose from {}": "the commands refuse others by their own lists",
    "there is no such kind; choose from {}": "tests/detect/test_cli.py",
    ": --slice {} {}": PART,
    "if it is not, give --laser-offset X Y DEG": "where the laser is; where the scans tell it, «to use it» follows",
    "{} topics to choose from: {}": PART,
    "rerun is switched off by the environment variable RERUN": "read once, when rerun is imported",
    "--serve-host: give an address of this machine": "tests/replay/viewing/test_serving.py",
    "the executable that rerun-sdk brings": "an installation",
    "replay it: prim-replay {}": ABOVE,
    "is neither a number nor a range such as 0-2": ABOVE,
    "name it with --set": USERS,
    "remove it to have it evaluated again": "its evaluation takes minutes",
    "make it anew": "the command and the file that it was made by",
    "prim-train export {} --stage {}{}": ABOVE,
    "make an ONNX file of it with: {}": ABOVE,
    " --mapper {}": PART,
    "holds several networks for: {}; keep one of each": USERS,
    "dataset {} --mapper {}": PART,
    "make one with: prim-train {}": ABOVE,
    "make the set in an empty folder with prim-train dataset": "the options that it was made with",
    "give another folder": USERS,
    "give another file": USERS,
    "add --trust": TRUST,
}
"""Words of the hints that no table of situations has: where they are given, or why they are not."""


def test_every_hint_is_given_or_is_not_for_a_reason() -> None:
    tables = {situation.hint for situation in (*SITUATIONS.values(), *RECORDINGS.values())}
    known = {*tables, *NOT_IN_TABLES}
    found = hints.hints_of_sources()
    assert [f"{place}: {text}" for text, place in found.items() if not any(part in text for part in known)] == []
    texts = hints.texts_of_sources()
    assert [part for part in known if not any(part in text for text in texts)] == [], (
        "no hint has these words any more"
    )
