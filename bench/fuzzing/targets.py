"""What coverage-guided fuzzing calls, and with what it begins: see bench.fuzz_guided."""

from __future__ import annotations

import json
import random
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from mcap.opcode import Opcode

from bench.fuzzing import mcap_file
from bench.fuzzing.damage import damaged_bytes
from bench.fuzzing.messages import SUBSTITUTES, ros2_types
from bench.fuzzing.records import damaged_bag_records, damaged_mcap_records, with_record
from bench.fuzzing.samples import Sample, Samples
from bench.fuzzing.summaries import lying_summary
from detect.networks.weights import SHIPPED, ModelCard
from prim import strict_json
from prim.errors import PrimError
from prim.log import open_log
from prim.log.decoding.codecs import ENCODINGS, Codec, codec_of, content_of
from prim.log.messages import TRUE_PRIMITIVES_TOPIC
from prim.world import World
from tests.encodings.ros1 import ros1_types, to_ros1

TYPES = (
    "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/MultiEchoLaserScan", "sensor_msgs/msg/PointCloud2",
    "tf2_msgs/msg/TFMessage", "tf/msg/tfMessage", "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped", "geometry_msgs/msg/PointStamped",
    "geometry_msgs/msg/Vector3Stamped", "sensor_msgs/msg/NavSatFix", "visualization_msgs/msg/MarkerArray",
    "foxglove.LaserScan", "foxglove.PointCloud", "foxglove.FrameTransform", "foxglove.FrameTransforms",
    "foxglove.PoseInFrame", "foxglove.LocationFix",
)  # fmt: skip
"""The types of messages that are decoded."""

WHOLE, METADATA = 0, 1
"""The first byte of an input of the logs: a file, or the metadata.yaml of a bag's folder."""
INPUT_SHAPE = (1, 3, 640, 640)
"""Of the images that networks are checked for."""
NETWORKS = 40
"""Hostile networks that fuzzing begins with."""
CDR_HEAD = 4
"""The encapsulation header (bytes)."""

Mutate = Callable[[bytes], bytes]


class Target(NamedTuple):
    """Something that takes bytes.

    Attributes:
        run: Takes them; raises nothing but what is ``expected``.
        expected: What it may raise.
        seeds: Yields inputs to begin with.
        mutate: Changes an input: from a source of randomness, an input, and libFuzzer's own mutation; None: that one.
    """

    run: Callable[[bytes], None]
    expected: tuple[type[Exception], ...]
    seeds: Callable[[Samples], Iterator[bytes]]
    mutate: Callable[[random.Random, bytes, Mutate], bytes] | None = None


def read_everything(data: bytes) -> None:
    """Read a log plainly and to recover it: topics, messages, stamps, decoded messages, and what else it holds."""
    with TemporaryDirectory(prefix="prim-fuzz-") as folder:
        path = Path(folder)
        if data[:1] == bytes([METADATA]):
            for name, content in _folder().items():
                (path / name).write_bytes(content)
            (path / "metadata.yaml").write_bytes(data[1:])
        else:
            path = path / "log"
            path.write_bytes(data[1:])
        for recover in (False, True):
            with suppress(PrimError):
                _read(path, recover)


def _read(path: Path, recover: bool) -> None:
    with open_log(path, recover) as log:
        assert isinstance(log.format, str) and isinstance(log.messages_lost, int | None)
        dict(log.metadata)
        log.attachment("world.json")
        for topic in log.topics.values():
            log.log_times(topic.name)  # type: ignore[attr-defined]  # all readers have it
            if topic.content is None or codec_of(topic.type, topic.encoding) is None:
                continue
            with suppress(PrimError):
                for _ in log.decoded(topic):
                    pass
                for _ in log.stamps(topic):
                    pass
        for _ in log.messages(*log.topics):
            pass
        assert all(isinstance(line, str) for line in (*log.lost, *log.notes))


@cache
def _folder() -> dict[str, bytes]:
    """Return the files of a bag's folder, without its metadata."""
    return dict(_FOLDER)


_FOLDER: dict[str, bytes] = {}


def _log_seeds(samples: Samples) -> Iterator[bytes]:
    for sample in samples.by_name.values():
        for name, data in sample.files.items():
            yield bytes([METADATA if name.endswith(".yaml") else WHOLE]) + data


def use_folder(samples: Samples) -> None:
    """Let inputs that are a bag's metadata.yaml lie beside the files of a sample.

    Args:
        samples: The samples.
    """
    files = samples.by_name["mcap-split"].files
    _FOLDER.update({name.split("/")[-1]: data for name, data in files.items() if not name.endswith(".yaml")})


def mutate_log(rng: random.Random, data: bytes, mutate: Mutate) -> bytes:
    """Change a log by its structure where it has any: records, indexes and messages, with CRCs that are right.

    Args:
        rng: The source of randomness.
        data: The log, behind its first byte.
        mutate: libFuzzer's mutation.

    Returns:
        The changed log.
    """
    kind, log = data[:1], data[1:]
    if not log or kind == bytes([METADATA]) or rng.random() < 0.2:
        return kind + mutate(log)
    sample = Sample("mcap", {"log": log}, True, True)
    alone = Samples(_NO_CONTENT, {"mcap": sample})
    changes: list[Callable[[], bytes]] = [lambda: damaged_bytes(rng, alone).files["log"]]
    if log.startswith(mcap_file.MAGIC):
        changes += [
            lambda: _only_file(damaged_mcap_records(rng, alone)),
            lambda: _only_file(lying_summary(rng, alone)),
            lambda: mutated_message(rng, sample, mutate),
            lambda: mutated_message(rng, sample, mutate),
        ]
    elif log.startswith(b"#ROSBAG"):
        changes += [lambda: _only_file(damaged_bag_records(rng, alone))] * 3
    try:
        return kind + rng.choice(changes)()
    except Exception:  # an earlier change has left too little of its structure
        return kind + mutate(log)


_NO_CONTENT: Any = None


def _only_file(case: Any) -> bytes:
    return next(iter(case.files.values()))


def mutated_message(rng: random.Random, sample: Sample, mutate: Mutate) -> bytes:
    """Change a record in a chunk of an MCAP file, and make the CRC right again.

    Args:
        rng: The source of randomness.
        sample: The file.
        mutate: Changes the record's body.

    Returns:
        The file.
    """
    size = len(mcap_file.MAGIC)
    records = mcap_file.split(sample.data[size:-size])
    at = rng.choice([k for k, record in enumerate(records) if record.opcode == Opcode.CHUNK])
    chunk = mcap_file.decode(records[at])
    inner = mcap_file.split(mcap_file.unpacked(chunk))
    chosen = rng.randrange(len(inner))
    inner[chosen] = inner[chosen]._replace(body=mutate(inner[chosen].body))
    return with_record(sample, records, at, mcap_file.repacked(chunk, inner))


def _codecs() -> list[Codec]:
    found = (codec_of(kind, encoding) for kind in TYPES for encoding in ENCODINGS)
    return [codec for codec in found if codec is not None]


def _index_of(kind: str, encoding: str) -> int:
    pairs = [(k, e) for k in TYPES for e in ENCODINGS if codec_of(k, e) is not None]
    return pairs.index((kind, encoding))


def decode(data: bytes) -> None:
    """Decode a message, and its stamp, by the codec that the first byte chooses."""
    codecs = _codecs()
    codec = codecs[data[0] % len(codecs)] if data else codecs[0]
    for read in (codec.decode, codec.stamp):
        with suppress(ValueError):
            read(data[1:])


def _message_seeds(samples: Samples) -> Iterator[bytes]:
    """Yield one message of each type and encoding, as far as the samples have any, and an empty one of each."""
    content = samples.content
    for substitute in SUBSTITUTES:
        message = content.of(substitute.topic)[0]
        value = substitute.convert(ros2_types().deserialize_cdr(message.data, content.types[message.topic]))
        yield from _serialized(substitute.type, value)
    firsts = {message.topic: message for message in reversed(content.messages)}
    for topic, message in firsts.items():
        yield bytes([_index_of(content.types[topic], "cdr")]) + message.data
    for old in {old.topic: old for old in to_ros1(content)}.values():
        yield bytes([_index_of(content.types[old.topic], "ros1")]) + old.data
    for name, encoding in (("foxglove-json", "json"), ("foxglove-protobuf", "protobuf")):
        for kind, data in _stored(samples.by_name[name]):
            yield bytes([_index_of(kind, encoding)]) + data
    yield from (bytes([number]) for number in range(len(_codecs())))


def _serialized(kind: str, value: Any) -> Iterator[bytes]:
    yield bytes([_index_of(kind, "cdr")]) + bytes(ros2_types().serialize_cdr(value, kind))
    with suppress(Exception):  # ROS 1 has other fields
        yield bytes([_index_of(kind, "ros1")]) + bytes(ros1_types().serialize_ros1(value, kind))


def _stored(sample: Sample) -> Iterator[tuple[str, bytes]]:
    """Yield a message of each topic of an MCAP sample, and its type."""
    with TemporaryDirectory(prefix="prim-fuzz-") as folder:
        path = Path(folder) / "log"
        path.write_bytes(sample.data)
        with open_log(path) as log:
            for topic in log.topics.values():
                yield topic.type, next(iter(log.messages(topic.name))).data


def parse_documents(data: bytes) -> None:
    """Parse a world, a model card, or any other JSON, as the first byte chooses."""
    text = data[1:].decode("utf-8", "surrogateescape")
    parsers: tuple[Callable[[str], object], ...] = (
        lambda text: World.from_json(strict_json.loads(text)).to_json(),
        lambda text: ModelCard.from_json(text).to_json(),
        lambda text: strict_json.dumps(strict_json.loads(text)) and strict_json.shown(strict_json.loads(text)),
    )
    with suppress(ValueError):
        parsers[data[0] % len(parsers) if data else 0](text)


def _document_seeds(samples: Samples) -> Iterator[bytes]:
    world = samples.content.attachments["world.json"]
    yield from (bytes([number]) + world for number in (0, 2))
    yield b"\x01" + ModelCard("yolo", "prob", thresholds={"circle": 0.5}, about={"a": [1]}).to_json().encode()
    yield b"\x01" + ModelCard("cnn", "det", preset="paper").to_json().encode()
    yield b"\x02" + json.dumps({"a": [1e308, None, True, "\u0001"]}).encode()
    for message in samples.content.of(TRUE_PRIMITIVES_TOPIC):
        yield b"\x02" + message.data[CDR_HEAD:]


def has_network_check() -> bool:
    """Return whether networks are checked before they run."""
    return find_spec("detect.networks.onnx_check") is not None


def check_network(data: bytes) -> None:
    """Read a network and check what it would compute."""
    file, check = import_module("detect.networks.onnx_file"), import_module("detect.networks.onnx_check")
    with suppress(PrimError, ValueError):
        check.check_network(file.read_network(data), INPUT_SHAPE)


def _network_seeds(samples: Samples) -> Iterator[bytes]:
    yield from (path.read_bytes()[:4096] for path in SHIPPED.glob("*/*.onnx"))
    if find_spec("bench.fuzzing.networks") is not None:
        make = import_module("bench.fuzzing.networks").hostile_networks
        yield from (made[-1] for made in islice(make(random.Random(0)), NETWORKS) if len(made[-1]) < 1 << 17)


TARGETS = {
    "logs": Target(read_everything, (), _log_seeds, mutate_log),
    "codecs": Target(decode, (), _message_seeds),
    "documents": Target(parse_documents, (), _document_seeds),
    "networks": Target(check_network, (), _network_seeds),
}
"""All targets by their names; what they expect to be raised they catch themselves."""


def targets() -> dict[str, Target]:
    """Return the targets that are there."""
    return {name: target for name, target in TARGETS.items() if name != "networks" or has_network_check()}


assert all(content_of(kind) for kind in TYPES)
