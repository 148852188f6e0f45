"""Logs of strangers that claim much, contradict themselves, or hold what none should."""

import gzip
import random
import sqlite3
import struct
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
import zstandard

from bench.fuzzing.formats import (
    MESSAGES,
    TOPICS,
    Chunk,
    bag,
    connection,
    database,
    hostile_logs,
    message,
)
from prim.errors import LogReadError
from prim.log import bags, log_file, open_log, reader
from prim.log.limits import memory_limit, records_limit, unpacked_limit
from prim.log.log_file import HEAD_BYTES, LogFile
from tests import hints
from tests.encodings import ros1, ros2
from tests.prim.log.small_log import small_log, stored

SCANS = connection()
NINE = Chunk(SCANS + b"".join(message(k, bytes([k])) for k in range(9)), {0: range(9)})
ODOM = b"ODOM 0 0 0 0 0 0 1.0 host 1.0\n"


def written(folder: Path, data: bytes, name: str = "log") -> Path:
    path = folder / name
    path.write_bytes(data)
    return path


def read(path: Path, recover: bool) -> tuple[int, list[str], int | None]:
    """Decode all that is of use; return how many messages that are, and what was lost."""
    count = 0
    with open_log(path, recover) as log:
        for topic in log.topics.values():
            if topic.content and topic.messages:
                count += sum(1 for _ in log.decoded(topic))
        return count, list(log.lost), log.messages_lost


@pytest.mark.parametrize("recover", [False, True])
@pytest.mark.parametrize("largest", [1 << 17, pytest.param(1 << 26, marks=pytest.mark.slow)])
def test_hostile_logs_are_refused_in_a_line(tmp_path: Path, recover: bool, largest: int) -> None:
    for what, name, data in hostile_logs(random.Random(0)):
        if len(data) > largest:
            continue
        path = written(tmp_path, data, name)
        try:
            _, lost, _ = read(path, recover)
        except LogReadError as error:
            assert "\n" not in str(error) and len(str(error)) < 1000, what
        else:
            assert (recover and len(lost) <= 101) or not lost, what


def test_limits_are_by_the_size_of_the_file_as_the_user_names_it(tmp_path: Path) -> None:
    packed = gzip.compress(ODOM)
    file = LogFile(written(tmp_path, packed))
    assert file.file_bytes == len(packed) < file.data.stat().st_size + len(packed)
    for limit in (memory_limit, unpacked_limit, records_limit):
        assert limit(0) > 0 and limit(10**9) > limit(10**6) > limit(0)
    file.close()


@pytest.mark.parametrize("compress", [gzip.compress, zstandard.compress])
@pytest.mark.parametrize("layers", [1, 2])
def test_a_bomb_is_refused_with_both_sizes_and_what_unpacks_it(
    tmp_path: Path, compress: Callable[[bytes], bytes], layers: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(log_file, "unpacked_limit", lambda file_bytes: 1 << 20)
    data = bytes(3 << 20)
    for _ in range(layers):
        data = compress(data)
    path = written(tmp_path, data, "a b")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(LogReadError) as caught:
        LogFile(path, recover=True)
    assert f"its {len(data)} bytes unpack to more than {1 << 20} bytes" in str(caught.value)
    hint = hints.find("if you trust it, unpack it with: ", str(caught.value))
    (unpacked,) = hints.run_in_shell(hint.partition(": ")[2])
    assert unpacked.read_bytes() == bytes(3 << 20)


def test_a_frame_that_refers_back_too_far_is_refused_before_it_takes_memory(tmp_path: Path) -> None:
    data = zstandard.ZstdCompressor(
        compression_params=zstandard.ZstdCompressionParameters(window_log=28, enable_ldm=True)
    ).compressobj()
    path = written(tmp_path, data.compress(b"x") + data.flush())
    with pytest.raises(LogReadError, match=r"134217728 bytes of memory; unpack it with: zstd -dc --long=31"):
        LogFile(path)


@pytest.mark.parametrize(
    "nothing", [gzip.compress(b"", mtime=0), zstandard.compress(b""), b"\x50\x2a\x4d\x18\0\0\0\0"]
)
def test_very_many_frames_of_nothing_are_nothing(tmp_path: Path, nothing: bytes) -> None:
    with pytest.raises(LogReadError, match="empty: "):
        LogFile(written(tmp_path, nothing * 1000))


@pytest.mark.parametrize(("claim", "what"), [(True, "claims 3145728 bytes"), (False, "larger than")])
def test_a_message_that_unpacks_to_much_is_lost(
    tmp_path: Path, claim: bool, what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reader, "memory_limit", lambda file_bytes: 1 << 20)
    bomb = zstandard.ZstdCompressor(write_content_size=claim).compress(bytes(3 << 20))
    path = written(tmp_path, bag([Chunk(SCANS + message(1, bomb), {0: [1]})], [SCANS]))
    count, lost, number = read(path, recover=True)
    assert (count, number) == (0, 1) and what in lost[-1]


def contradictions() -> list[tuple[str, bytes, int]]:
    """Bags, what is wrong with each, and how many messages of nine are left."""
    records = NINE.records
    of_two = Chunk(SCANS + message(1, b"a") + message(2, b"b"), {0: [1, 2]})
    return [
        ("9 messages where the index counts 8", bag([Chunk(records, {0: range(8)})], [SCANS]), 9),
        ("messages of other times", bag([Chunk(records, {0: range(1, 10)})], [SCANS]), 9),
        ("a chunk that the index does not have", bag([NINE, of_two], [SCANS], [0]), 11),
        ("is listed twice", bag([NINE, of_two], [SCANS], [0, 0]), 11),
        ("connection 0 is another one elsewhere", bag([NINE], [connection("/other")]), 0),
        ("which nothing describes", bag([Chunk(message(1, b"", 7), {7: [1]})], [SCANS]), 0),
        ("a connection without its topic or type", bag([NINE], [connection().replace(b"type=", b"tape=")]), 9),
        ("it unpacks to more than the 99 bytes", bag([Chunk(records, NINE.times, b"bz2", 99)], [SCANS]), 0),
        ("it unpacks to more than the 99 bytes", bag([Chunk(records, NINE.times, b"lz4", 99)], [SCANS]), 0),
        (f"{len(records)} bytes where it claims", bag([Chunk(records, NINE.times, b"lz4", 9999)], [SCANS]), 9),
        ("that claims 1073741824, more than", bag([Chunk(records, NINE.times, b"bz2", 1 << 30)], [SCANS]), 0),
        ("a record of kind 5 in a chunk", bag([Chunk(records + NINE.packed(), NINE.times)], [SCANS]), 9),
        (
            "a header does not fit together",
            bag([Chunk(records + b"\x10\0\0\0" + b"\4\0\0\0op=\2" * 2 + bytes(4))], [SCANS]),
            9,
        ),
        ("no record begins there", bag([Chunk(records + bytes(80))], [SCANS]), 9),
        ("its last record runs past the end", bag([NINE], [SCANS]) + b"\xff\0\0\0", 9),
    ]


@pytest.mark.parametrize(("what", "data", "left"), contradictions())
def test_a_bag_that_contradicts_itself_is_damaged(tmp_path: Path, what: str, data: bytes, left: int) -> None:
    path = written(tmp_path, data)
    if "last record" not in what:
        with pytest.raises(LogReadError, match=what):
            open_log(path)
    messages, lost, _ = stored(path, recover=True)
    assert len(messages) == left and lost


def test_an_index_behind_a_chunk_is_compared_with_it(tmp_path: Path) -> None:
    data = bytearray(bag([NINE], [SCANS]))
    at = data.index(struct.pack("<III", 3, 0, 0))
    data[at] = 4
    path = written(tmp_path, bytes(data))
    with pytest.raises(LogReadError, match="an index of the chunk at byte 4109 does not agree with it"):
        open_log(path)
    assert len(stored(path, recover=True)[0]) == 9


@pytest.mark.parametrize("write", [ros1.write_bag, ros1.write_bag_bz2])
def test_behind_a_hole_a_bag_goes_on_with_its_next_chunk(tmp_path: Path, write: Callable[..., Path]) -> None:
    path = write(small_log(), tmp_path)
    whole, data = stored(path)[0], bytearray(path.read_bytes())
    at = data.index(b"op=\x05", len(data) // 3)
    data[at - 8 : at + 48] = bytes(56)
    path.write_bytes(data)
    messages, lost, count = stored(path, recover=True)
    assert set(messages) < set(whole) and messages[-1] == whole[-1] and lost and count == len(whole) - len(messages)
    at = data.index(b"index_pos=") + len(b"index_pos=")
    data[at : at + 8] = bytes(8)
    path.write_bytes(data)
    assert stored(path, recover=True)[0] == messages


def test_a_bag_of_many_chunks_that_each_unpack_to_much_is_refused(tmp_path: Path) -> None:
    large = SCANS + message(1, bytes(2 << 20))
    path = written(tmp_path, bag([Chunk(large, {0: [1]}, b"bz2")] * 5, [SCANS]))
    with pytest.raises(LogReadError, match=r"unpack to more than \d+ bytes; if you trust it, .*rosbag decompress"):
        open_log(path, recover=True)


def test_a_bag_of_more_records_than_its_bytes_can_hold_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bags, "records_limit", lambda file_bytes, limits: 1000)
    many = Chunk(SCANS + message(1, b"") * 9000, {0: [1] * 9000}, b"bz2")
    with pytest.raises(LogReadError, match=r"more than \d+ records"):
        open_log(written(tmp_path, bag([many], [SCANS])), recover=True)


def changed(path: Path, script: str) -> Path:
    base = sqlite3.connect(path)
    base.executescript(script)
    base.close()
    return path


@pytest.mark.parametrize(
    ("script", "what"),
    [
        ("UPDATE messages SET topic_id = 9 WHERE id = 7", "of a topic that is not listed"),
        ("UPDATE messages SET timestamp = 'x' WHERE id = 7", "time is no number"),
        ("UPDATE messages SET timestamp = -9223372036854775808 WHERE id = 7", "time is no number"),
        ("UPDATE messages SET data = 'text' WHERE id = 7", "data are no bytes"),
        ("UPDATE topics SET name = x'00' WHERE id = 1", "a topic whose number or type is none"),
    ],
)
def test_values_of_other_types_in_a_database_are_damage(tmp_path: Path, script: str, what: str) -> None:
    path = changed(ros2.write_db3_foxy(small_log(), tmp_path), script)
    with pytest.raises(LogReadError, match=what):
        open_log(path)
    messages, lost, _ = stored(path, recover=True)
    assert messages and len(messages) < 180 and what in lost[0]


def test_rows_that_a_page_lost_are_missed_by_the_index(tmp_path: Path) -> None:
    path = ros2.write_db3_foxy(small_log(), tmp_path)
    whole, data = stored(path)[0], bytearray(path.read_bytes())
    page = next(at for at in range(4096, len(data), 4096) if data[at] == 13 and data[at + 4] > 2)  # a leaf
    data[page + 4] -= 1  # the number of its rows
    path.write_bytes(data)
    with pytest.raises(LogReadError, match=r"its index has \d+ messages, which are not the \d+ that are there"):
        open_log(path)
    messages, lost, _ = stored(path, recover=True)
    assert set(messages) < set(whole) and lost


def test_a_message_larger_than_the_limit_is_lost(tmp_path: Path) -> None:
    rows = f"INSERT INTO messages VALUES(1, 1, 1, x'00'), (2, 1, 2, zeroblob({40 << 20})), (3, 1, 3, x'00');"
    packed = zstandard.compress(database(TOPICS + MESSAGES + rows))
    path = written(tmp_path, packed)
    with pytest.raises(LogReadError, match="too big"):
        stored(path)
    messages, lost, _ = stored(path, recover=True)
    assert [m.log_time for m in messages] == [1, 3] and "too big" in lost[0]


def test_rows_that_claim_more_than_the_file_holds_are_damage(tmp_path: Path) -> None:
    bare = MESSAGES.replace(", data BLOB", "") + "INSERT INTO messages VALUES(1, 1, 1), (2, 1, 2), (3, 1, 3);"
    default = f"ALTER TABLE messages ADD COLUMN data BLOB DEFAULT x'{'00' * 30_000}'"
    path = written(tmp_path, database(TOPICS + bare + default))
    with pytest.raises(LogReadError, match="its messages claim 90000 bytes of"):
        open_log(path)
    assert "claim 90000 bytes" in stored(path, recover=True)[1][0]


def test_a_query_without_an_end_is_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("prim.log.sqlite.STEPS_BASE", 0)
    monkeypatch.setattr("prim.log.sqlite.STEPS_A_BYTE", 0)
    monkeypatch.setattr("prim.log.sqlite.STEPS_AT_ONCE", 100)
    path = ros2.write_db3_foxy(small_log(), tmp_path)
    for recover in (False, True):
        with pytest.raises(LogReadError, match="takes too many steps"):
            open_log(path, recover)


WILD_LINES = (
    "ODOM 0 0 inf 0 0 0 2.0 host 1.0",
    "ODOM 0 0 0 0 0 0 1e300 host 1.0",
    f"ODOM 0 0 0 0 0 0 {'9' * 4000}.0 host 1.0",
    "FLASER 1000000000 1 2 3",
    "FLASER 1 1.0 0 0 inf 0 0 inf 1e308 host 1.0",
    "FLASER 1 1.0 0 0 inf 0 0 inf nan host 1.0",
    "ROBOTLASER1 0 nan 0 nan 1e999 0 0 1 1.0 -1 0 0 0 0 0 0 0 0 0 0 0 3.0 host 1.0",
)


@pytest.mark.parametrize("line", WILD_LINES)
def test_wild_numbers_in_a_line_are_a_loss(tmp_path: Path, line: str) -> None:
    path = written(tmp_path, ODOM + line.encode() + b"\n" + ODOM)
    with pytest.raises(LogReadError, match="cannot be decoded"):
        read(path, recover=False)
    count, lost, _ = read(path, recover=True)
    assert count == 2 and len(lost) == 1


def test_poses_that_are_none_move_no_laser(tmp_path: Path) -> None:
    lines = [f"FLASER 2 1.0 1.0 {x} 0 0 {x} 0 0 {k}.0 host 1.0\n" for k, x in enumerate((0, "nan", 1, "1e300", 2))]
    with open_log(written(tmp_path, "".join(lines).encode())) as log:
        assert "tf_static" not in log.topics
        poses = [found[0].translation[0] for _, found in log.decoded(log.topics["robot_poses"])]
    assert np.array_equal(poses, [0, np.nan, 1, 1e300, 2], equal_nan=True)


@pytest.mark.parametrize(
    ("middle", "what"),
    [
        (b"ODOM 0 0 0 \0\0\0 0 0 0 2.0 host 1.0\n", "bytes that are no text"),
        (b"\0" * 56 + b"\n", "bytes that are no text"),
        (b"FLASER " + b"1 " * (3 << 20) + b"\n", "lines of more than 4194304 bytes"),
    ],
)
def test_lines_that_are_none_are_a_loss(tmp_path: Path, middle: bytes, what: str) -> None:
    path = written(tmp_path, ODOM + middle + ODOM)
    with pytest.raises(LogReadError, match=what):
        open_log(path)
    assert read(path, recover=True) == (2, [what if what.startswith("lines") else f"lines with {what}"], None)


def test_a_last_line_that_is_cut_is_a_loss(tmp_path: Path) -> None:
    path = written(tmp_path, ODOM * 2 + ODOM[:-12])
    with pytest.raises(LogReadError, match="a last line that is cut"):
        open_log(path)
    assert read(path, recover=True) == (2, ["a last line that is cut"], None)
    assert read(written(tmp_path, ODOM * 2 + ODOM[:-1]), recover=False) == (3, [], 0)


def test_more_lines_than_bytes_can_hold_are_refused(tmp_path: Path) -> None:
    path = written(tmp_path, gzip.compress(ODOM + b"\n" * (1 << 18)))
    with pytest.raises(LogReadError, match=r"more than \d+ lines in \d+ bytes; if you trust it, unpack it"):
        open_log(path, recover=True)


def listing(folder: Path, names: Sequence[str], more: str = "") -> Path:
    lines = "".join(f"    - {name}\n" for name in names)
    text = f"rosbag2_bagfile_information:\n  version: 5\n  relative_file_paths:\n{lines}{more}"
    (folder / "metadata.yaml").write_text(text)
    return folder


def test_a_list_of_too_many_files_is_refused(tmp_path: Path) -> None:
    listing(tmp_path, [f"bag_{k}.mcap" for k in range(10_001)])
    with pytest.raises(LogReadError, match="a list of 10001 files, more than 10000"):
        open_log(tmp_path)


def test_a_list_that_is_too_large_is_refused_but_not_its_file(tmp_path: Path) -> None:
    (tmp_path / "metadata.yaml").write_text("a: " + "x" * (5 << 20))
    path = ros2.write_mcap(small_log(4), tmp_path)
    with pytest.raises(LogReadError, match=r"a list of files of \d+ bytes, more than 4194304"):
        open_log(tmp_path)
    assert stored(path)[0]


def test_aliases_of_aliases_end(tmp_path: Path) -> None:
    laughs = "a0: &a0 {x: 1}\n" + "".join(
        f"a{k}: &a{k} {{<<: [{', '.join([f'*a{k - 1}'] * 9)}]}}\n" for k in range(1, 30)
    )
    (tmp_path / "metadata.yaml").write_text(laughs + "rosbag2_bagfile_information: {relative_file_paths: [a.mcap]}")
    ros2.write_mcap(small_log(4), tmp_path).rename(tmp_path / "a.mcap")
    assert stored(tmp_path)[0]


@pytest.mark.parametrize("name", ["..", '"a\\0b.mcap"', "n" * 300 + ".mcap", "/dev/zero", "../../secret.mcap"])
def test_names_that_are_none_are_not_followed(tmp_path: Path, name: str) -> None:
    listing(tmp_path, [name])
    with pytest.raises(LogReadError):
        open_log(tmp_path)
    ros2.write_mcap(small_log(4), tmp_path)
    assert stored(tmp_path, recover=True)[0]


def test_a_file_of_two_names_is_read_once(tmp_path: Path) -> None:
    path = ros2.write_mcap(small_log(4), tmp_path).rename(tmp_path / "bag_0.mcap")
    whole = stored(path)[0]
    (tmp_path / "bag_1.mcap").symlink_to(path)
    assert stored(tmp_path)[0] == whole
    assert stored(listing(tmp_path, ["bag_0.mcap", "bag_1.mcap"]))[0] == whole


def test_names_of_many_files_are_not_all_shown(tmp_path: Path) -> None:
    for k in range(30):
        (tmp_path / f"log{chr(97 + k % 26)}{k}x.mcap").write_bytes(b"")
    with pytest.raises(LogReadError, match=r"30 logs \(.* and 10 more\)"):
        open_log(tmp_path)


def test_pieces_that_unpack_to_much_are_small() -> None:
    assert memory_limit(0) >= log_file.PACKED_BYTES * (128 << 10) // 4


@pytest.mark.parametrize("text", [b"\n", b" \n", b"#\n", b"\t", b"\r\n", b"# \n\n"])
def test_what_begins_a_text_is_found_in_linear_time(tmp_path: Path, text: bytes) -> None:
    """Texts of blank lines alone: a test that does not end is one that fails."""
    path = tmp_path / "a.log"
    path.write_bytes(text * (HEAD_BYTES // len(text)))
    with pytest.raises(LogReadError, match="not a log of a known format"):
        stored(path)
    path.write_bytes(text.replace(b"\t", b"\n") * 1000 + b"ODOM 0 0 0 0 0 0 1.0 h 1.0\n")
    assert [message.topic for message in stored(path)[0]] == ["ODOM"]
