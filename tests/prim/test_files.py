import os
import re
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from prim.errors import OutputError, UsageError
from prim.files import OutputFile, ResultFormat, check_distinct, check_no_input, check_output, write_file, write_files

LETTER = ResultFormat("a letter", re.compile(rb"Dear "))


def test_a_file_is_in_its_place_only_when_it_is_complete(tmp_path: Path) -> None:
    file = OutputFile(tmp_path / "a", LETTER)
    file.part.write_bytes(b"Dear reader")
    assert not (tmp_path / "a").exists()
    file.commit()
    assert (tmp_path / "a").read_bytes() == b"Dear reader"
    assert list(tmp_path.iterdir()) == [tmp_path / "a"]


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


def test_what_is_no_regular_file_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (Path("/dev/null"), tmp_path / "pipe", tmp_path, tmp_path / "no" / "folder"):
        with pytest.raises(OutputError, match="cannot write"):
            write_file(path, b"Dear reader", LETTER, force=True)
    assert Path("/dev/null").is_char_device()


def test_a_link_stays_a_link(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "a")
    write_file(tmp_path / "link", b"Dear reader", LETTER)
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "a").read_bytes() == b"Dear reader"


def test_an_input_is_known_under_all_of_its_names(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    bag.mkdir()
    for name in ("metadata.yaml", "bag_0.mcap", "bag.prob.report.json"):
        (bag / name).touch()
    os.link(bag / "bag_0.mcap", tmp_path / "hard")
    (tmp_path / "soft").symlink_to(bag / "bag_0.mcap")
    for path in (bag / "metadata.yaml", bag / "bag_0.mcap", tmp_path / "hard", tmp_path / "soft"):
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
    run = subprocess.run(
        [sys.executable, "-c", code, tmp_path / "a"], capture_output=True, text=True, cwd=Path(__file__).parents[2]
    )
    assert "File too large" in run.stdout, run.stderr
    assert (tmp_path / "a").read_bytes() == b"Dear friend"
    assert list(tmp_path.iterdir()) == [tmp_path / "a"]
