import re
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_typestore

from prim.errors import InterruptedRunError, LogReadError, OutputError
from prim.log import open_log
from prim.log.messages import SCAN_TOPIC, SCAN_TYPE, encode_scan
from prim.log.source import LogSource
from prim.log.writer import LogWriter
from prim.scan import Scan
from recorder.session import Session


def write_log(path: Path, scans: int = 300, beams: int = 500) -> list[Scan]:
    rng = np.random.default_rng(0)
    written = [
        Scan(10**9 + i * 10**8, "laser", 0.0, 0.01, 0.1, 5.0, rng.random(beams, dtype=np.float32))
        for i in range(scans)
    ]
    with LogWriter(path) as log:
        log.add_metadata("prim", {"seed": "1"})
        log.add_attachment("world.json", "application/json", b"{}", 1)
        log.add_topic(SCAN_TOPIC, SCAN_TYPE)
        for scan in written:
            log.write(SCAN_TOPIC, scan.stamp, encode_scan(scan))
    return written


def read_scans(path: Path, recover: bool = False) -> tuple[list[Scan], LogSource]:
    with open_log(path, recover=recover) as log:
        topic = log.topics[SCAN_TOPIC]
        return [scan for _, scan in log.decoded(topic)], log


def test_what_is_written_is_read(tmp_path: Path) -> None:
    written = write_log(tmp_path / "a.mcap")
    read, log = read_scans(tmp_path / "a.mcap")
    assert [scan.stamp for scan in read] == [scan.stamp for scan in written]
    assert all((a.ranges == b.ranges).all() for a, b in zip(read, written, strict=True))
    assert log.metadata["prim"] == {"seed": "1"}
    assert log.topics[SCAN_TOPIC].messages == 300
    assert not (tmp_path / "a.mcap.part").exists()
    with open_log(tmp_path / "a.mcap") as again:
        assert again.attachment("world.json") == b"{}"
        assert again.attachment("other") is None


def test_other_libraries_decode_every_message(quiet_session: Session) -> None:
    """mcap-ros2-support reads each message by the schema in the log, rosbags by its own definitions."""
    store = get_typestore(Stores.ROS2_JAZZY)
    topics = set()
    with quiet_session.path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
            theirs = store.deserialize_cdr(message.data, schema.name)
            first = getattr(decoded, "header", None)
            if first is not None:
                assert first.stamp.sec == theirs.header.stamp.sec > 0
            topics.add(channel.topic)
    assert topics == {
        *("/scan", "/odom", "/gps", "/compass", "/tf", "/tf_static"),
        *("/ground_truth/pose", "/ground_truth/primitives"),
    }


def test_rosbags_reads_the_schemas_in_the_log(quiet_session: Session) -> None:
    from rosbags.typesys import get_types_from_msg

    with quiet_session.path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    for schema in summary.schemas.values():
        assert schema.name in get_types_from_msg(schema.data.decode(), schema.name)


def cut(path: Path, share: float) -> Path:
    data = path.read_bytes()
    part = path.with_name("cut.mcap")
    part.write_bytes(data[: int(len(data) * share)])
    return part


@pytest.mark.parametrize("share", [0.01, 0.3, 0.9, 0.9999])
def test_a_truncated_log_is_refused_and_can_be_recovered(tmp_path: Path, share: float) -> None:
    written = write_log(tmp_path / "a.mcap")
    part = cut(tmp_path / "a.mcap", share)
    with pytest.raises(LogReadError, match=r"truncated.*--recover"):
        read_scans(part)
    if share > 0.5:
        read, log = read_scans(part, recover=True)
        assert [scan.stamp for scan in read] == [scan.stamp for scan in written[: len(read)]]
        assert len(read) >= 300 * (share - 0.35)
        assert len(log.lost) == 1
        assert "beyond byte" in log.lost[0]


def test_a_damaged_chunk_is_detected_and_the_others_are_recovered(tmp_path: Path) -> None:
    written = write_log(tmp_path / "a.mcap", scans=600)
    data = bytearray((tmp_path / "a.mcap").read_bytes())
    data[len(data) // 2] ^= 0xFF
    (tmp_path / "b.mcap").write_bytes(data)
    with pytest.raises(LogReadError, match=r"damaged.*--recover"):
        read_scans(tmp_path / "b.mcap")
    read, log = read_scans(tmp_path / "b.mcap", recover=True)
    assert 300 < len(read) < 600
    assert {scan.stamp for scan in read} <= {scan.stamp for scan in written}
    assert len(log.lost) == 1
    assert "a chunk at byte" in log.lost[0]
    with open_log(tmp_path / "b.mcap", recover=True) as again:
        assert again.messages_lost == 600 - len(read)


def test_an_intact_log_is_the_same_when_recovered(tmp_path: Path) -> None:
    write_log(tmp_path / "a.mcap")
    whole, _ = read_scans(tmp_path / "a.mcap")
    read, log = read_scans(tmp_path / "a.mcap", recover=True)
    assert [scan.stamp for scan in read] == [scan.stamp for scan in whole]
    assert log.lost == []


def test_a_damaged_summary_is_detected(tmp_path: Path) -> None:
    write_log(tmp_path / "a.mcap")
    data = bytearray((tmp_path / "a.mcap").read_bytes())
    data[-100] ^= 0x01
    (tmp_path / "b.mcap").write_bytes(data)
    with pytest.raises(LogReadError, match=r"CRC of its summary.*--recover"):
        read_scans(tmp_path / "b.mcap")
    assert len(read_scans(tmp_path / "b.mcap", recover=True)[0]) == 300


def test_an_interrupted_recording_keeps_what_was_written(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with pytest.raises(InterruptedRunError, match=r"a\.mcap\.\w+\.part"), LogWriter(path) as log:
        log.add_topic(SCAN_TOPIC, SCAN_TYPE)
        log.write(SCAN_TOPIC, 1, encode_scan(Scan(1, "laser", 0.0, 0.1, 0.1, 5.0, np.ones(3, dtype=np.float32))))
        raise KeyboardInterrupt
    assert not path.exists()
    assert len(read_scans(log.part)[0]) == 1


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (b"", "an empty file"),
        (b"\x89PNG\r\n\x1a\n" + b"\0" * 99, "a PNG image"),
        (b"#ROSBAG V2.0\n" + b"\0" * 99, "damaged"),
        (b"SQLite format 3\0" + b"\0" * 99, "damaged"),
        (b"hello", "not a log of a known format"),
        (b"\x89MCAP0\r\n", "truncated"),
        (b"\x89MCAP0\r\n" * 9, "truncated"),
    ],
)
def test_other_files_are_refused_by_what_they_are(tmp_path: Path, content: bytes, what: str) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    with pytest.raises(LogReadError, match=what) as error:
        open_log(path)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)


def test_a_folder_is_read_where_it_holds_one_log(tmp_path: Path) -> None:
    with pytest.raises(LogReadError, match="without a log"):
        open_log(tmp_path)
    write_log(tmp_path / "bag_0.mcap", scans=3)
    assert len(read_scans(tmp_path)[0]) == 3
    write_log(tmp_path / "other.mcap", scans=3)
    with pytest.raises(LogReadError, match=r"bag_0\.mcap, other\.mcap"):
        open_log(tmp_path)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LogReadError, match="No such file"):
        open_log(tmp_path / "none.mcap")


def test_an_output_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    for path in (tmp_path / "no" / "folder.mcap", tmp_path):
        with pytest.raises(OutputError, match=re.escape(f"{path}: cannot write")):
            LogWriter(path)
