"""What the commands leave when they are interrupted, killed, run side by side, or find no place on the disk."""

import json
import os
import random
import re
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mapping.grid import GridFrame, OccupancyGrid
from prim.errors import UsageError
from prim.files import ResultFormat
from prim.log import open_log
from recorder.session import Session
from replay.outputs import exports

ROOT = Path(__file__).parents[2]

LIMIT = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({0}, {0}))\n"


def command(part: str, *arguments: object, before: str = "") -> list[str]:
    code = f"import sys; sys.path.insert(0, {str(ROOT)!r})\n{before}from {part}.__main__ import main; main()"
    return [sys.executable, "-c", code, *map(str, arguments)]


def run(
    folder: Path, part: str, *arguments: object, before: str = "", **options: object
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(  # type: ignore[call-overload,no-any-return]
        command(part, *arguments, before=before), cwd=folder, capture_output=True, text=True, **options
    )


def is_whole(recording: Path) -> bool:
    return recording.read_bytes()[-12:-4] == b"RRF2FOOT"


def interrupted(folder: Path, log: Path, number: int, *options: str) -> tuple[int, str]:
    """Interrupt a replay that is held to a slow rate, when some scans are mapped: exit code and stderr."""
    arguments = [log, "--rate", "0.05", *options]
    process = subprocess.Popen(command("replay", *arguments), cwd=folder, stderr=subprocess.PIPE, text=True)
    while not list(folder.glob("*.rrd.*.part")) and process.poll() is None:
        time.sleep(0.02)
    time.sleep(2.5)
    process.send_signal(number)
    return process.wait(30), process.communicate()[1]


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_an_interrupted_replay_keeps_what_was_made(
    tmp_path: Path, noisy_session: Session, number: int, code: int
) -> None:
    exit_code, error = interrupted(tmp_path, noisy_session.path, number, "--map", "m")
    assert exit_code == code, error
    report = json.loads((tmp_path / "noisy.prob.report.json").read_text())
    assert report["interrupted"] is True
    assert 0 < report["log"]["scans_used"] < report["log"]["scans"]
    assert report["log"]["duration_s"] == pytest.approx((report["log"]["scans_used"] - 1) / 10)
    assert is_whole(tmp_path / "noisy.prob.rrd")
    names = {"m.pgm", "m.yaml", "noisy.prob.report.json", "noisy.prob.rrd"}
    assert {path.name for path in tmp_path.iterdir()} == names
    assert re.search(r"note: interrupted after \d+ of \d+ scans", error)
    assert "Traceback" not in error, error


def test_an_interrupted_replay_leaves_earlier_results(tmp_path: Path, noisy_session: Session) -> None:
    assert run(tmp_path, "replay", noisy_session.path).returncode == 0
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    exit_code, error = interrupted(tmp_path, noisy_session.path, signal.SIGINT)
    assert exit_code == 130
    assert "earlier results stay as they are" in error
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
    exit_code, error = interrupted(tmp_path, noisy_session.path, signal.SIGINT, "--force")
    assert exit_code == 130, error
    assert json.loads((tmp_path / "noisy.prob.report.json").read_text())["interrupted"] is True


@pytest.mark.parametrize("races", [1, pytest.param(20, marks=pytest.mark.slow)])
def test_recorders_and_replays_side_by_side_damage_nothing(tmp_path: Path, races: int) -> None:
    for race in range(races):
        records = [command("recorder", "a.mcap", "--stops", "4", "4", "--seed", 3 * race + lane) for lane in range(3)]
        for process in [subprocess.Popen(record, cwd=tmp_path, stdout=subprocess.DEVNULL) for record in records]:
            assert process.wait() == 0
        with open_log(tmp_path / "a.mcap") as log:
            assert log.topics["/scan"].messages > 5
        replays = [command("replay", "a.mcap", "--quiet", "--no-detect") for _ in range(3)]
        for process in [subprocess.Popen(replay, cwd=tmp_path) for replay in replays]:
            assert process.wait() == 0
        assert is_whole(tmp_path / "a.prob.rrd")
        assert json.loads((tmp_path / "a.prob.report.json").read_text())["interrupted"] is False
        assert len(list(tmp_path.iterdir())) == 3


def killed(folder: Path, number: int, delay: float, part: str, *arguments: object) -> tuple[int, str]:
    """Signal a command some time after its entry point was reached: exit code and stderr."""
    before = f"import {part}.__main__; sys.stderr.write('ready'); sys.stderr.flush()\n"
    process = subprocess.Popen(
        command(part, *arguments, before=before), cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )
    assert process.stderr is not None
    assert process.stderr.read(5) == b"ready"
    time.sleep(delay)
    process.send_signal(number)
    return process.wait(30), process.communicate()[1].decode()


def state(path: Path) -> str:
    """What a command has left under a name; fails where a file is not whole that has its own name."""
    if path.suffix == ".part":
        return "part"
    if path.suffix == ".rrd":
        assert is_whole(path)
    elif path.suffix == ".mcap":
        with open_log(path) as log:
            assert log.topics["/scan"].messages > 0
    elif path.suffix == ".json":
        return "report until then" if json.loads(path.read_text())["interrupted"] else "report"
    return path.suffix


REPLAY = ["replay", "--mapper", "prob", "--map", "m", "--trajectory", "t.tum"]
RECORD = ["recorder", "new.mcap", "--motion", "drive", "--duration", "20"]


@pytest.mark.slow
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGKILL, -9)])
@pytest.mark.parametrize("arguments", [REPLAY, RECORD])
def test_kills_at_random_moments_leave_no_damaged_file(
    tmp_path: Path, noisy_session: Session, arguments: list[str], number: int, code: int
) -> None:
    """100 of each command: 40 by Ctrl-C, 30 by a request to end, 30 without a chance to clean up."""
    part, *options = arguments
    if part == "replay":
        options.append(str(noisy_session.path))
    start = time.monotonic()
    assert run(tmp_path, part, *options).returncode == 0
    seconds = 1.1 * (time.monotonic() - start)
    rng, seen = random.Random(number), Counter[tuple[object, ...]]()
    for _ in range(40 if number == signal.SIGINT else 30):
        for path in tmp_path.iterdir():
            path.unlink()
        found, error = killed(tmp_path, number, rng.uniform(0, seconds), part, *options)
        assert found in (0, code, -number), error
        assert "Traceback" not in error, error
        assert "bug" not in error
        if kept := re.search(r"what was recorded until then is in (.*)\.part", error):
            Path(f"{kept[1]}.part").rename(tmp_path / "kept.mcap")
        states = [state(path) for path in tmp_path.iterdir()]
        if number != signal.SIGKILL:
            assert "part" not in states
        if found == 0 or (found == -number and number != signal.SIGKILL):  # all is done, and Python itself is ending
            assert len(states) == (5 if part == "replay" else 1)
        seen[found, *sorted(states)] += 1
        assert run(tmp_path, part, *options).returncode == 0  # nothing that was left is in the way
    print(dict(seen))


def test_a_disk_that_is_full_costs_only_what_does_not_fit(tmp_path: Path, noisy_session: Session) -> None:
    """With little room the recording fails, and the report is written; an earlier recording stays."""
    options = [noisy_session.path, "--no-detect", "--trajectory", "t.tum"]
    assert run(tmp_path, "replay", *options).returncode == 0
    before = (tmp_path / "noisy.prob.rrd").read_bytes()
    (tmp_path / "noisy.prob.report.json").unlink()
    for room in (len(before) - 500, 30_000):
        found = run(tmp_path, "replay", *options, before=LIMIT.format(room))
        assert found.returncode == 1
        assert found.stderr.splitlines()[-1].startswith("prim-replay: error: ")
        assert "the recording could not be written in full" in found.stderr
        assert "\x1b" not in found.stderr
        assert (tmp_path / "noisy.prob.rrd").read_bytes() == before
        assert json.loads((tmp_path / "noisy.prob.report.json").read_text())["interrupted"] is False
    assert {path.name for path in tmp_path.iterdir()} == {"noisy.prob.rrd", "noisy.prob.report.json", "t.tum"}


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("r.json", ["--report", "r.json"]),
        ("m.pgm", ["--map", "m"]),
        ("t.tum", ["--trajectory", "t.tum"]),
    ],
)
def test_a_full_disk_leaves_the_earlier_report_map_or_trajectory(
    tmp_path: Path, noisy_session: Session, name: str, options: list[str]
) -> None:
    arguments = [noisy_session.path, "--no-detect", "--no-viewer", *options]
    assert run(tmp_path, "replay", *arguments, "--n-scans", 9).returncode == 0
    report = "noisy.prob.report.json"  # of the map's and the trajectory's replay: it may have found room
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.name != report}
    for room in (len(before[name]) // 2, 200):
        found = run(tmp_path, "replay", *arguments, before=LIMIT.format(room))
        assert found.returncode == 1
        assert f"prim-replay: error: {name}: cannot write: File too large" in found.stderr
        assert {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.name != report} == before
        if name != "r.json":
            json.loads((tmp_path / report).read_text())


def test_a_recorder_on_a_full_disk_leaves_the_earlier_log(tmp_path: Path) -> None:
    assert run(tmp_path, "recorder", "a.mcap").returncode == 0
    before = (tmp_path / "a.mcap").read_bytes()
    for room in (len(before) - 100, 3000):
        found = run(tmp_path, "recorder", "a.mcap", before=LIMIT.format(room))
        assert (found.returncode, found.stderr.count("\n")) == (1, 1)
        assert "cannot write: File too large" in found.stderr
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == {tmp_path / "a.mcap": before}


@pytest.mark.parametrize(
    ("name", "part", "entry", "number", "code"),
    [
        ("prim-replay", "replay", "main", signal.SIGINT, 130),
        ("prim-replay", "replay", "main", signal.SIGTERM, 143),
        ("prim-record", "recorder", "main", signal.SIGTERM, 143),
        ("prim-train", "detect", "main", signal.SIGTERM, 143),
        ("prim-eval", "detect", "main_eval", signal.SIGTERM, 143),
    ],
)
def test_an_interruption_while_a_command_is_loaded_is_one_line(
    tmp_path: Path, name: str, part: str, entry: str, number: int, code: int
) -> None:
    """It comes before there is a command that could handle it."""
    interrupt = f"""\
import os
class Finder:
    def find_spec(self, name, path, target=None):
        if name == "typer":
            os.kill(os.getpid(), {int(number)})
sys.meta_path.insert(0, Finder())
from {part}.__main__ import {entry} as main
main()
"""
    found = run(tmp_path, part, before=interrupt)
    assert (found.returncode, found.stderr) == (code, f"{name}: error: interrupted\n")


def test_an_interrupted_process_waits_for_no_thread(tmp_path: Path) -> None:
    """A thread may wait for a lock, as of an import, that an interruption has never given back."""
    code = """\
import threading
from prim.console import exit_process
threading.Thread(target=threading.Event().wait).start()
print("some output", end="")
exit_process(130)
"""
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    found = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, env=buffered, capture_output=True, text=True, timeout=60
    )
    assert (found.returncode, found.stdout, found.stderr) == (130, "some output", "")


def test_logs_of_others_and_inputs_are_never_replaced(tmp_path: Path, noisy_session: Session) -> None:
    content = noisy_session.path.read_bytes()
    own, bag = tmp_path / "own.mcap", tmp_path / "bag.mcap"
    own.write_bytes(content)
    bag.write_bytes(content.replace(b"\x04\0\0\0prim", b"\x04\0\0\0else", 1))
    os.link(own, tmp_path / "hard.json")
    (tmp_path / "world.json").write_text('{"size": [2, 2], "primitives": [], "walls": []}')
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    replay = ["replay", own, "--no-detect"]
    for arguments, error in (
        (["recorder", bag], "--force to replace it"),
        (["recorder", "world.json", "--world", "world.json", "--force"], "is the input world.json"),
        ([*replay, "--save", bag], "--force to replace it"),
        ([*replay, "--save", "world.json"], "--force to replace it"),
        ([*replay, "--no-viewer", "--report", "hard.json", "--force"], "is the input"),
        ([*replay, "--no-viewer", "--report", own, "--force"], "is the input"),
        ([*replay, "--no-viewer", "--trajectory", "world.json"], "--force to replace it"),
    ):
        found = run(tmp_path, *arguments)
        assert (found.returncode, found.stderr.count("\n")) == (2, 1), found.stderr
        assert error in found.stderr
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
    again = run(tmp_path, *replay, "--no-viewer", "--trajectory", "world.json", "--force")
    assert (again.returncode, again.stdout.splitlines()[-1]) == (0, "replaced: world.json")


@pytest.mark.parametrize(
    ("result", "content"),
    [
        (exports.REPORT, b'{"schema": "another/1"}'),
        (exports.RECORDING, b"RRF2" + bytes(300)),
        (exports.MAP_IMAGE, b"P5\n2 1\n255\n\0\0"),
        (exports.MAP_DESCRIPTION, b"image: m.pgm\nresolution: 0.05\norigin: [0, 0, 0]\nnegate: 0\n"),
        (exports.TRAJECTORY, b"1.5 0.1 0.2 0 0 0 0 1\n"),
    ],
    ids=lambda value: value.name if isinstance(value, ResultFormat) else "",
)
def test_files_of_other_programs_are_no_earlier_results(tmp_path: Path, result: ResultFormat, content: bytes) -> None:
    (tmp_path / "a").write_bytes(content)
    assert not result.recognizes(tmp_path / "a")


def test_a_map_of_another_program_is_replaced_by_force_alone(tmp_path: Path) -> None:
    grid = OccupancyGrid(GridFrame(0.05, 0, 0, rows=2, cols=1), np.full((2, 1), 0.5, np.float32))
    (tmp_path / "m.yaml").write_text("image: m.pgm\n")
    with pytest.raises(UsageError, match="--force"):
        exports.write_map(tmp_path / "m", grid)
    assert [path.name for path in tmp_path.iterdir()] == ["m.yaml"]
    exports.write_map(tmp_path / "m", grid, force=True)
    assert len(list(tmp_path.iterdir())) == 2


def test_earlier_results_are_replaced_and_a_line_says_so(tmp_path: Path, noisy_session: Session) -> None:
    options = [noisy_session.path, "--no-detect", "--map", "m", "--trajectory", "t.tum"]
    assert "replaced" not in run(tmp_path, "replay", *options).stdout
    line = "replaced: noisy.prob.rrd, noisy.prob.report.json, m.pgm, m.yaml, t.tum"
    assert run(tmp_path, "replay", *options).stdout.splitlines()[-2:] == [line, "open:  rerun noisy.prob.rrd"]


def free_of_files(home: Path) -> dict[str, str]:
    return os.environ | {"HOME": str(home), "XDG_CACHE_HOME": "", "XDG_CONFIG_HOME": "", "XDG_DATA_HOME": ""}


NO_NETWORK = """\
import ctypes, struct
class Filter(ctypes.Structure): _fields_ = [("length", ctypes.c_ushort), ("code", ctypes.c_char_p)]
steps = [(0x20, 0, 0, 0), (0x15, 0, 4, 41), (0x20, 0, 0, 16), (0x15, 1, 0, 2), (0x15, 0, 1, 10),
         (0x06, 0, 0, 0x80000000), (0x06, 0, 0, 0x7FFF0000)]
code = b"".join(struct.pack("HBBI", *step) for step in steps)
libc = ctypes.CDLL(None, use_errno=True)
assert libc.prctl(38, 1, 0, 0, 0) == 0 and libc.prctl(22, 2, ctypes.byref(Filter(len(steps), code))) == 0
"""
"""Let Linux on x86-64 kill the process (SIGSYS) when it asks for a socket of the internet."""


@pytest.fixture
def without_network(tmp_path: Path) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Return a function that runs a command which may not ask for an internet socket, in an empty home."""
    attempt = [sys.executable, "-c", f"{NO_NETWORK}import socket; socket.socket()"]
    if os.uname().machine != "x86_64" or subprocess.run(attempt, check=False).returncode != -signal.SIGSYS:
        pytest.skip("system calls cannot be filtered here")
    home = tmp_path / "home"
    home.mkdir()

    def run_it(folder: Path, part: str, *arguments: object) -> subprocess.CompletedProcess[str]:
        found = run(folder, part, *arguments, before=NO_NETWORK, env=free_of_files(home))
        assert list(home.rglob("*")) == []
        return found

    return run_it


@pytest.mark.skipif(sys.platform != "linux", reason="system calls are filtered as Linux does it")
def test_no_command_asks_for_the_network_or_writes_elsewhere(
    tmp_path: Path, without_network: Callable[..., subprocess.CompletedProcess[str]]
) -> None:
    work = tmp_path / "work"
    work.mkdir()
    assert without_network(work, "recorder", "a.mcap", "--stops", "4", "4").returncode == 0
    found = without_network(work, "replay", "a.mcap", "--mapper", "det,prob,forward")
    assert found.returncode == 0, found.stderr
    names = {"a.mcap", "a.det-prob-forward.rrd", *(f"a.{name}.report.json" for name in ("det", "prob", "forward"))}
    assert {path.name for path in work.iterdir()} == names
    for part in ("recorder", "replay", "detect"):
        assert without_network(work, part, "--help").returncode == 0
    assert socket.AF_INET == 2


def test_a_pipe_is_no_log(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for name in ("pipe", "/dev/stdin"):
        found = run(tmp_path, "replay", name, "--no-viewer", input="", timeout=60)
        assert (found.returncode, found.stderr.count("\n")) == (1, 1)
        assert "cannot be read back and forth" in found.stderr


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_reader_that_has_gone_is_no_error(tmp_path: Path, unbuffered: str) -> None:
    """As of «| head», when it has read enough."""
    reading, writing = os.pipe()
    os.close(reading)
    environment = os.environ | {"PYTHONUNBUFFERED": unbuffered}
    found = subprocess.run(
        command("recorder", "a.mcap"), cwd=tmp_path, env=environment, stdout=writing, stderr=subprocess.PIPE
    )
    os.close(writing)
    assert (found.returncode, found.stderr) == (0, b"")


def test_odd_surroundings_are_no_bugs(tmp_path: Path, noisy_session: Session) -> None:
    """Names that are no UTF-8, stdout that is ASCII, closed or full, a working folder that is gone."""
    log = tmp_path / "gr\udcfc\u00df\x1b[2J.mcap"
    log.write_bytes(noisy_session.path.read_bytes())
    options = [log.name, "--no-detect", "--map", "m\udcfc", "--trajectory", "t\udcfc.tum"]
    for before in ("", "sys.stdout = None; import os; os.close(1)\n", "sys.stdout = open('/dev/full', 'w')\n"):
        found = run(tmp_path, "replay", *options, before=before, env=os.environ | {"PYTHONIOENCODING": "ascii"})
        assert found.returncode == (1 if "full" in before else 0), found.stderr
        assert "bug" not in found.stderr
        assert "\x1b" not in found.stdout + found.stderr
        assert len([path for path in tmp_path.iterdir() if path.suffix != ".mcap"]) == 5
        (report,) = tmp_path.glob("*.json")
        assert json.loads(report.read_text())["log"]["path"].isprintable()
    gone = tmp_path / "gone"
    gone.mkdir()
    found = run(gone, "replay", log, before="import os; os.rmdir(os.getcwd())\n")
    assert found.returncode == 2
    assert found.stderr == ("prim-replay: error: the working folder does not exist any more: change to another one\n")
