import ast
import os
import re
import resource
import stat
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from prim.errors import OutputError, UsageError
from prim.files import (
    MARKED_BYTES,
    OutputFile,
    ResultFormat,
    check_distinct,
    check_no_input,
    check_output,
    write_file,
    write_files,
)

ROOT = Path(__file__).parents[2]
WRITING = re.compile(r"\.(write_bytes|write_text|tofile|imwrite)\(|open\([^()]*'[rb]*[wax+]")

LETTER = ResultFormat("a letter", re.compile(rb"Dear "))


def test_a_file_is_in_its_place_only_when_it_is_complete(tmp_path: Path) -> None:
    file = OutputFile(tmp_path / "a", LETTER)
    file.part.write_bytes(b"Dear reader")
    assert not (tmp_path / "a").exists()
    file.commit()
    assert (tmp_path / "a").read_bytes() == b"Dear reader"
    assert list(tmp_path.iterdir()) == [tmp_path / "a"]


def test_a_file_is_synced_before_it_is_renamed_and_its_folder_afterwards(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else a loss of power leaves an empty file in the place of a good one."""
    synced: list[tuple[int, bool]] = []

    def sync(descriptor: int) -> None:
        synced.append((os.fstat(descriptor).st_ino, (tmp_path / "a").exists()))

    monkeypatch.setattr("prim.files.os.fsync", sync)
    write_file(tmp_path / "a", b"Dear reader", LETTER)
    assert synced == [((tmp_path / "a").stat().st_ino, False), (tmp_path.stat().st_ino, True)]


def test_two_files_in_the_making_never_share_a_name(tmp_path: Path) -> None:
    first, second = OutputFile(tmp_path / "a", LETTER), OutputFile(tmp_path / "a", LETTER)
    first.part.write_bytes(b"Dear first")
    second.part.write_bytes(b"Dear second")
    second.commit()
    first.commit()
    assert (tmp_path / "a").read_bytes() == b"Dear first"
    assert list(tmp_path.iterdir()) == [tmp_path / "a"]


def test_a_name_that_another_process_has_taken_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tokens = iter(["00000000", "11111111"])
    monkeypatch.setattr("prim.files.secrets.token_hex", lambda _: next(tokens))
    (tmp_path / "a.00000000.part").write_bytes(b"theirs")
    assert OutputFile(tmp_path / "a", LETTER).part.name == "a.11111111.part"
    assert (tmp_path / "a.00000000.part").read_bytes() == b"theirs"


@pytest.mark.parametrize("name", ["a" * 255, "ü" * 127, "\udcff" * 255])
def test_a_name_may_be_as_long_as_the_system_takes_it(tmp_path: Path, name: str) -> None:
    write_file(tmp_path / name, b"Dear reader", LETTER)
    assert list(tmp_path.iterdir()) == [tmp_path / name]


@pytest.mark.parametrize("content", [b"", b"Dear friend"])
def test_earlier_results_and_empty_files_are_replaced(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a").write_bytes(content)
    (tmp_path / "a").chmod(0o640)
    assert check_output(tmp_path / "a", LETTER)
    write_file(tmp_path / "a", b"Dear reader", LETTER)
    assert (tmp_path / "a").read_bytes() == b"Dear reader"
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o640


@pytest.mark.parametrize("size", [0, 2 * MARKED_BYTES])
def test_a_result_is_recognised_by_its_end(tmp_path: Path, size: int) -> None:
    signed = ResultFormat("a signed letter", re.compile(rb"Yours, prim"), at_end=True)
    (tmp_path / "a").write_bytes(b"Dear reader" + bytes(size) + b"Yours, prim\n")
    assert check_output(tmp_path / "a", signed)
    (tmp_path / "a").write_bytes(b"Yours, prim" + bytes(2 * MARKED_BYTES))
    with pytest.raises(UsageError, match="is not a signed letter"):
        check_output(tmp_path / "a", signed)


def test_of_files_that_belong_together_all_are_replaced_or_none(tmp_path: Path) -> None:
    first, second = tmp_path / "a", tmp_path / "b"
    write_files([(first, b"Dear first", LETTER), (second, b"Dear second", LETTER)])
    second.unlink()
    second.mkdir()
    with pytest.raises(OutputError, match="b: cannot write"):
        write_files([(first, b"Dear reader", LETTER), (second, b"Dear reader", LETTER)])
    assert first.read_bytes() == b"Dear first"
    assert set(tmp_path.iterdir()) == {first, second}


def test_another_file_is_replaced_by_force_alone(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"mine")
    with pytest.raises(UsageError, match=r"a exists and is not a letter: give another name, or --force"):
        write_file(tmp_path / "a", b"Dear reader", LETTER)
    assert (tmp_path / "a").read_bytes() == b"mine"
    write_file(tmp_path / "a", b"Dear reader", LETTER, force=True)
    assert (tmp_path / "a").read_bytes() == b"Dear reader"


def test_a_file_that_appears_meanwhile_stays_and_so_does_what_was_written(tmp_path: Path) -> None:
    file = OutputFile(tmp_path / "a", LETTER)
    file.part.write_bytes(b"Dear reader")
    (tmp_path / "a").write_bytes(b"mine")
    with pytest.raises(UsageError, match=re.escape(str(file.part))):
        file.commit()
    assert (tmp_path / "a").read_bytes() == b"mine"
    assert file.part.read_bytes() == b"Dear reader"


def test_a_file_that_cannot_be_put_in_its_place_is_removed(tmp_path: Path) -> None:
    file = OutputFile(tmp_path / "a", LETTER)
    (tmp_path / "a").mkdir()
    with pytest.raises(OutputError, match="a: cannot write"):
        file.commit()
    assert list(tmp_path.iterdir()) == [tmp_path / "a"]


def test_what_is_no_regular_file_is_refused(tmp_path: Path) -> None:
    """A device of the test's own: as root, code that fails here would replace the machine's."""
    os.mkfifo(tmp_path / "pipe")
    with suppress(PermissionError):  # only root may make one
        os.mknod(tmp_path / "null", stat.S_IFCHR | 0o666, os.makedev(1, 3))
    before = {path: path.stat().st_mode for path in tmp_path.iterdir()}
    for path in (*before, tmp_path):
        with pytest.raises(OutputError, match="cannot write"):
            write_file(path, b"Dear reader", LETTER, force=True)
    assert {path: path.stat().st_mode for path in tmp_path.iterdir()} == before


def test_a_missing_folder_is_named_as_such(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"a: cannot write: there is no folder \S*no; choose another place"):
        write_file(tmp_path / "no" / "a", b"Dear reader", LETTER)


def test_a_link_stays_a_link(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "a")
    write_file(tmp_path / "link", b"Dear reader", LETTER)
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "a").read_bytes() == b"Dear reader"


def test_an_input_is_known_under_all_of_its_names(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    bag.mkdir()
    inputs = ("metadata.yaml", "bag_0.mcap", "bag_1.mcap.zstd", "bag_0.db3", "bag_1.db3.zstd", "yolo.onnx")
    for name in (*inputs, "bag.prob.report.json"):
        (bag / name).touch()
    os.link(bag / "bag_0.mcap", tmp_path / "hard")
    (tmp_path / "soft").symlink_to(bag / "bag_0.mcap")
    for path in (*(bag / name for name in inputs), tmp_path / "hard", tmp_path / "soft"):
        with pytest.raises(UsageError, match="the input"):
            check_no_input([bag], [path])
    check_no_input([bag], [bag / "bag.prob.report.json", tmp_path / "new"])


def test_no_file_is_written_twice(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "a")
    with pytest.raises(UsageError, match="written twice"):
        check_distinct([tmp_path / "a", tmp_path / "b", tmp_path / "link"])


def test_a_full_disk_leaves_what_was_there(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"Dear friend")
    code = (
        "import resource, sys; from pathlib import Path; from tests.prim.test_files import *\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
        "try: write_file(Path(sys.argv[1]), b'Dear ' * 1000, LETTER)\n"
        "except OutputError as error: print(error)"
    )
    assert resource.RLIMIT_FSIZE is not None
    run = subprocess.run([sys.executable, "-c", code, tmp_path / "a"], capture_output=True, text=True, cwd=ROOT)
    assert "File too large" in run.stdout, run.stderr
    assert (tmp_path / "a").read_bytes() == b"Dear friend"
    assert list(tmp_path.iterdir()) == [tmp_path / "a"]


def test_nothing_else_writes_files() -> None:
    """Else a full disk or an interruption would leave half a file in the place of a good one."""
    others = set()
    for part in ("prim", "recorder", "mapping", "detect", "replay"):
        for path in (ROOT / part).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text("utf-8"))):
                if isinstance(node, ast.Call) and WRITING.search(ast.unparse(node)):
                    others.add(path.relative_to(ROOT).as_posix())
    assert others == {
        "prim/files.py",
        "prim/console.py",  # /dev/null in the place of a closed stream
        "prim/log/writer.py",  # the part of an OutputFile
        "prim/log/log_file.py",  # a temporary file
    }
