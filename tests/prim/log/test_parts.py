"""Split bags: parts that are missing, in another order, under other names, or alone."""

import gzip
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zstandard

from prim.errors import LogReadError
from prim.log import open_log
from prim.log.source import Message
from tests.encodings import ros1, ros2
from tests.encodings.content import LogContent, parts
from tests.prim.log.small_log import log_times, small_log

Write = Callable[[LogContent, Path], Path]


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return ros2.write_mcap_split(small_log(), tmp_path)


def read(path: Path, recover: bool = False) -> tuple[list[Message], list[str], list[str]]:
    with open_log(path, recover) as log:
        return list(log.messages(*log.topics)), list(log.notes), list(log.lost)


def relisted(bag: Path, change: Callable[[str], str]) -> Path:
    path = bag / "metadata.yaml"
    path.write_text(change(path.read_text()))
    return bag


@pytest.mark.parametrize("name", ["bag_0.mcap", "bag_1.mcap", "bag_2.mcap"])
def test_a_part_that_is_missing_is_a_loss(bag: Path, name: str) -> None:
    whole = read(bag)[0]
    (bag / name).unlink()
    with pytest.raises(LogReadError, match=f"{name}: a file of the bag .* is missing; read the rest with --recover"):
        open_log(bag)
    messages, _, lost = read(bag, recover=True)
    assert set(messages) < set(whole) and len(lost) == 1 and name in lost[0]


def test_parts_are_read_in_the_order_of_their_times(bag: Path) -> None:
    whole = read(bag)[0]
    swapped = relisted(bag, lambda text: text.replace("_0.", "_x.").replace("_2.", "_0.").replace("_x.", "_2."))
    messages, notes, _ = read(swapped)
    assert messages == whole
    assert len(notes) == 1 and notes[0].endswith("in the order of their times: bag_0.mcap, bag_1.mcap, bag_2.mcap")


@pytest.mark.parametrize(
    "change",
    [
        lambda text: "rosbag2_bagfile_information:\n  version: 5\n",
        lambda text: "rosbag2_bagfile_information:\n  relative_file_paths: bag_0.mcap\n",
        lambda text: "rosbag2_bagfile_information:\n  relative_file_paths: [1, 2]\n",
        lambda text: "rosbag2_bagfile_information:\n  relative_file_paths: []\n",
        lambda text: text.replace("bag_", "before_it_was_renamed_"),
        lambda text: text[:60],
        lambda text: "{{{",
        lambda text: "",
    ],
)
def test_a_list_that_tells_nothing_is_not_needed(bag: Path, change: Callable[[str], str]) -> None:
    whole = read(bag)
    assert read(relisted(bag, change)) == whole


def test_parts_may_be_compressed_by_hand(bag: Path) -> None:
    whole = read(bag)
    for name, suffix, compress in (("bag_0.mcap", ".gz", gzip.compress), ("bag_1.mcap", ".zst", zstandard.compress)):
        (bag / (name + suffix)).write_bytes(compress((bag / name).read_bytes()))
        (bag / name).unlink()
    assert read(bag) == whole


def test_a_part_that_is_there_twice_is_read_once(bag: Path) -> None:
    whole = read(bag)
    (bag / "bag_1.mcap.zstd").write_bytes(zstandard.compress((bag / "bag_1.mcap").read_bytes()))
    assert read(bag) == whole
    (bag / "metadata.yaml").unlink()
    assert read(bag) == whole


def test_other_files_are_no_parts(bag: Path) -> None:
    whole = read(bag)
    (bag / "metadata.yaml").unlink()
    for name in ("bag_0.mcap.rrd", "bag_0.db3-wal", "bag.mcap.report.json"):
        (bag / name).write_bytes(b"RRF2")
    assert read(bag) == whole


def test_a_part_alone_says_where_the_others_are(bag: Path, tmp_path: Path) -> None:
    messages, notes, _ = read(bag / "bag_1.mcap")
    assert messages and len(notes) == 1
    assert "part 2 of 3" in notes[0] and notes[0].endswith(f"for all give {bag}")
    elsewhere = (bag / "bag_1.mcap").rename(tmp_path / "bag_1.mcap")
    assert read(elsewhere) == (messages, [], [])


def test_what_metadata_does_not_list_is_noted(bag: Path) -> None:
    fewer = relisted(bag, lambda text: text.replace("bag_2.mcap", "bag_1.mcap"))
    messages, notes, _ = read(fewer)
    times = log_times(messages)
    assert len(times) == len(set(times)) and len(notes) == 1 and "does not list bag_2.mcap" in notes[0]


def test_metadata_stands_for_its_folder(bag: Path) -> None:
    assert read(bag / "metadata.yaml") == read(bag)


def test_parts_of_ros_1_have_times_in_their_names(tmp_path: Path) -> None:
    content, folder = small_log(), tmp_path / "bags"
    folder.mkdir()
    for number, part in enumerate(parts(content, 12)):
        ros1.write_bag(part, tmp_path).rename(folder / f"run_2024-01-01-10-{number:02}-00_{number}.bag")
    messages, notes, _ = read(folder)
    assert [m.log_time for m in messages] == [m.log_time for m in content.messages] and not notes


@pytest.mark.parametrize("write", [ros2.write_mcap, ros2.write_db3_foxy, ros1.write_bag])
@pytest.mark.parametrize("recover", [False, True])
def test_log_times_are_those_of_the_messages(tmp_path: Path, write: Write, recover: bool) -> None:
    with open_log(write(small_log(), tmp_path), recover) as log:
        times = log.log_times("/scan")
        assert np.array_equal(times, log_times(log.messages("/scan")))
