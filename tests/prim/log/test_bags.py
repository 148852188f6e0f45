"""ROS 1 bags and ROS 2 bags in SQLite: damaged, cut, with odd names, with clocks that were set back."""

import shutil
import sqlite3
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from prim.errors import LogReadError
from prim.log import open_log
from tests.encodings import ros1, ros2
from tests.encodings.content import LogContent
from tests.prim.log.small_log import SECOND, log_times, set_back, small_log, stored

Write = Callable[[LogContent, Path], Path]

BAGS = [ros1.write_bag, ros1.write_bag_bz2, ros1.write_bag_lz4]


def cut(path: Path, share: float) -> Path:
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    return path


def without_index(path: Path) -> Path:
    """Make of a bag what its recorder leaves when it is killed: no index, and a head that does not know of one."""
    data = bytearray(path.read_bytes())
    at = data.index(b"index_pos=") + len(b"index_pos=")
    (index,) = struct.unpack_from("<Q", data, at)
    struct.pack_into("<Q", data, at, 0)
    path.write_bytes(data[:index])
    return path


@pytest.mark.parametrize("write", [*BAGS, ros2.write_db3, ros2.write_db3_foxy])
def test_an_intact_log_is_recovered_whole(tmp_path: Path, write: Write) -> None:
    content = small_log()
    path = write(content, tmp_path)
    plain, recovered = stored(path), stored(path, recover=True)
    assert plain == recovered
    assert (plain[1], plain[2], len(plain[0])) == ([], 0, len(content.messages))


@pytest.mark.parametrize("write", BAGS)
def test_a_bag_without_its_index_is_recovered(tmp_path: Path, write: Write) -> None:
    path = write(small_log(), tmp_path)
    whole = stored(path)[0]
    with pytest.raises(LogReadError, match="--recover"):
        open_log(without_index(path))
    assert stored(path, recover=True) == (whole, [], 0)


@pytest.mark.parametrize("write", BAGS)
def test_a_bag_that_is_cut_is_recovered_as_far_as_it_goes(tmp_path: Path, write: Write) -> None:
    path = write(small_log(), tmp_path)
    whole = stored(path)[0]
    with pytest.raises(LogReadError, match="--recover"):
        open_log(cut(path, 0.6))
    messages, lost, count = stored(path, recover=True)
    assert messages == whole[: len(messages)] and 0.4 * len(whole) < len(messages) < len(whole)
    assert lost and count is None


def test_a_damaged_chunk_of_a_bag_hides_no_other(tmp_path: Path) -> None:
    path = ros1.write_bag(small_log(), tmp_path, "BZ2")
    whole = stored(path)[0]
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 500] = bytes(500)
    path.write_bytes(data)
    with pytest.raises(LogReadError, match="--recover"):
        stored(path)
    messages, lost, count = stored(path, recover=True)
    assert messages[-1] == whole[-1] and messages[0] == whole[0] and set(messages) < set(whole)
    assert len(lost) == 1 and count == len(whole) - len(messages)


@pytest.mark.parametrize("share", [0.3, 0.8])
def test_a_database_that_is_cut_is_recovered_as_far_as_it_goes(tmp_path: Path, share: float) -> None:
    path = ros2.write_db3_foxy(small_log(), tmp_path)
    whole = stored(path)[0]
    with pytest.raises(LogReadError, match="--recover"):
        open_log(cut(path, share))
    messages, lost, count = stored(path, recover=True)
    assert messages == whole[: len(messages)] and (share - 0.25) * len(whole) < len(messages) < len(whole)
    assert lost and count is None


def test_a_damaged_page_of_a_database_hides_no_other(tmp_path: Path) -> None:
    path = ros2.write_db3_foxy(small_log(200), tmp_path)
    whole = stored(path)[0]
    data = bytearray(path.read_bytes())
    page = len(data) // 2 // 4096 * 4096
    data[page : page + 4096] = b"\xff" * 4096
    path.write_bytes(data)
    messages, lost, _ = stored(path, recover=True)
    assert messages[0] == whole[0] and messages[-1] == whole[-1]
    assert 0.8 * len(whole) < len(set(messages) & set(whole)) < len(whole) and lost


@pytest.mark.parametrize("name", ["a?b.db3", "a#b.db3", "100%.db3", "a%20b.db3", "a?mode=memory.db3", "ü '\".db3"])
def test_a_database_may_have_any_name(tmp_path: Path, name: str) -> None:
    path = ros2.write_db3_foxy(small_log(4), tmp_path)
    assert stored(path.rename(tmp_path / name))[0]


@pytest.mark.parametrize(
    "change",
    [
        "CREATE TABLE schema(schema_version INTEGER, ros_distro TEXT); INSERT INTO schema VALUES(9, 'later')",
        "ALTER TABLE topics DROP COLUMN offered_qos_profiles",
        "DROP INDEX timestamp_idx",
    ],
)
def test_a_database_may_have_another_schema(tmp_path: Path, change: str) -> None:
    path = ros2.write_db3_foxy(small_log(4), tmp_path)
    before = stored(path)
    base = sqlite3.connect(path)
    base.executescript(change)
    base.close()
    assert stored(path) == before


def test_what_is_still_in_the_write_ahead_log_is_read(tmp_path: Path) -> None:
    path = ros2.write_db3_foxy(small_log(), tmp_path)
    whole = stored(path)
    base = sqlite3.connect(path)
    base.execute("PRAGMA journal_mode = wal")
    rows = base.execute("SELECT * FROM messages WHERE id > 50").fetchall()
    base.execute("DELETE FROM messages WHERE id > 50")
    base.commit()
    base.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    base.executemany("INSERT INTO messages VALUES(?, ?, ?, ?)", rows)
    base.commit()
    killed = tmp_path / "killed"
    killed.mkdir()
    for name in (path.name, f"{path.name}-wal"):
        shutil.copy(tmp_path / name, killed / name)
    base.close()
    before = {file: file.read_bytes() for file in killed.iterdir()}
    assert stored(killed / path.name) == whole
    assert {file: file.read_bytes() for file in killed.iterdir()} == before


def test_a_message_without_data_is_one_that_cannot_be_decoded(tmp_path: Path) -> None:
    path = ros2.write_db3_foxy(small_log(4), tmp_path)
    base = sqlite3.connect(path)
    base.executescript(
        "CREATE TABLE other AS SELECT * FROM messages; DROP TABLE messages; ALTER TABLE other RENAME TO messages;"
        "UPDATE messages SET data = NULL WHERE id = 2"
    )
    base.close()
    with open_log(path) as log, pytest.raises(LogReadError, match="cannot be decoded"):
        list(log.numbered(*log.topics.values()))


def test_another_database_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.db3"
    base = sqlite3.connect(path)
    base.execute("CREATE TABLE t(a)")
    base.close()
    with pytest.raises(LogReadError, match="no ROS 2 bag"):
        open_log(path)


@pytest.mark.parametrize(
    "write",
    [
        ros1.write_bag,
        ros2.write_db3_foxy,
        ros2.write_mcap,
        ros2.write_mcap_unchunked,
        ros2.write_mcap_unindexed,
    ],
)
@pytest.mark.parametrize("recover", [False, True])
def test_times_that_were_set_back_are_moved_behind(tmp_path: Path, write: Write, recover: bool) -> None:
    path = write(small_log(clock=set_back), tmp_path)
    with open_log(path, recover) as log:
        assert len(log.notes) == 1 and "set back 1 time, by 2.0 s" in log.notes[0]
        messages = list(log.messages("/scan", "/odom"))
    for topic in ("/scan", "/odom"):
        steps = np.diff(log_times(messages, topic))
        assert ((steps > 0) & (steps < SECOND)).all()


def test_times_in_another_order_are_not_set_back(tmp_path: Path) -> None:
    content = small_log()
    messages = tuple(sorted(content.messages, key=lambda message: (message.topic, -message.log_time)))
    for write in (ros1.write_bag, ros2.write_db3_foxy, ros2.write_mcap):
        with open_log(write(LogContent(content.types, messages, {}, {}), tmp_path)) as log:
            assert not log.notes


@pytest.mark.parametrize("write", [ros2.write_mcap, ros2.write_mcap_unchunked])
def test_a_message_that_was_logged_beyond_all_times_is_damage(tmp_path: Path, write: Write) -> None:
    content = small_log(4)
    messages = tuple(m._replace(log_time=(1 << 64) - 1) if k == 3 else m for k, m in enumerate(content.messages))
    path = write(LogContent(content.types, messages, {}, {}), tmp_path)
    with open_log(path) as log, pytest.raises(LogReadError, match=r"beyond all times"):
        list(log.numbered(*log.topics.values()))
    with open_log(path, recover=True) as log:
        assert len(list(log.numbered(*log.topics.values()))) == len(messages) - 1
