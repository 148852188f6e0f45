"""Foxglove's messages, as JSON and protobuf, with wild values in every field; and any other text of JSON."""

from __future__ import annotations

import json
import random
from collections.abc import Callable, Iterator
from typing import Any

from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.LaserScan_pb2 import LaserScan
from mcap.opcode import Opcode
from mcap.records import Channel, Message

from bench.fuzzing import mcap_file
from bench.fuzzing.case import Case
from bench.fuzzing.mcap_file import Assembly
from bench.fuzzing.messages import COUNTS, FLOATS, MODES, chosen_messages, damaged_words, wild_value
from bench.fuzzing.samples import Sample, Samples


def wild_foxglove_messages(rng: random.Random, samples: Samples) -> Case:
    """Change messages of Foxglove's, in JSON or protobuf.

    Args:
        rng: The source of randomness.
        samples: The intact logs.

    Returns:
        The case.
    """
    if rng.random() < 0.5:
        what, data = wild_foxglove_json(rng, samples)
    else:
        what, data = with_changed_messages(rng, samples.by_name["foxglove-protobuf"], _wild_protobuf)
    options = ("--no-viewer", *rng.choice(MODES).split())
    return Case(what, {"log.mcap": data}, options=options)


def wild_foxglove_json(rng: random.Random, samples: Samples) -> tuple[str, bytes]:
    """Change messages of Foxglove's in JSON.

    Args:
        rng: The source of randomness.
        samples: The intact logs.

    Returns:
        What was done, and the file.
    """
    return with_changed_messages(rng, samples.by_name["foxglove-json"], wild_json)


def with_changed_messages(
    rng: random.Random, sample: Sample, change: Callable[[random.Random, str, bytes], tuple[str, bytes]]
) -> tuple[str, bytes]:
    """Return an MCAP sample in which some messages of a topic are changed, with indexes that fit.

    Args:
        rng: The source of randomness.
        sample: The sample, in chunks.
        change: From a topic and a message to what was done and the changed message.

    Returns:
        What was done, and the file.
    """
    size = len(mcap_file.MAGIC)
    inner = [
        mcap_file.decode(record)
        for chunk in mcap_file.split(sample.data[size:-size])
        if chunk.opcode == Opcode.CHUNK
        for record in mcap_file.split(mcap_file.unpacked(mcap_file.decode(chunk)))
    ]
    topics = {record.id: record.topic for record in inner if isinstance(record, Channel)}
    channel = rng.choice(list(topics))
    own = [record for record in inner if isinstance(record, Message) and record.channel_id == channel]
    chosen = chosen_messages(rng, len(own))
    what, file = "", Assembly()
    for number in chosen:
        what, own[number].data = change(rng, topics[channel], own[number].data)
    file.add(*inner)
    return f"{sample.name}: {len(chosen)} of {topics[channel]}: {what}", file.finish()


JSON_VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1e308, -1e308, 1 << 70, -(1 << 70), 10**400, "", "NaN", "Infinity", "x" * 2000, [], {},
    [[]], [None] * 50, {"sec": 1}, [1, "a"], "\x1b[2J", 1e-320, 2**63, 0.5, [1e308] * 3, {"x": {}},
    "2024-13-01T00:00:00Z",
)  # fmt: skip
JSON_TEXTS = (
    "1e999", "-1e999", "NaN", "Infinity", "9" * 5000, "[" * 100_000, "[" * 100_000 + "]" * 100_000, '{"a":' * 100_000,
    "-0", "1.0e-999", '"\\ud800"', '"\\u0000"', "", "{", '"', "nul", "[1,]", "\ufeff{}",
)  # fmt: skip
MARK = "\u0001mark"
"""Stands where a text of JSON is put that json itself would not write."""


def wild_json(rng: random.Random, topic: str, data: bytes) -> tuple[str, bytes]:
    """Change one value of a JSON text.

    Args:
        rng: The source of randomness.
        topic: For what it is.
        data: The text.

    Returns:
        What was done, and the text.
    """
    value = json.loads(data)
    if rng.random() < 0.08:
        text = rng.choice(JSON_TEXTS)
        return f"{topic} is {text[:20]}", text.encode("utf-8", "surrogatepass")
    places = list(_json_places(value))
    path, holder, key = rng.choice(places)
    if rng.random() < 0.2 and isinstance(holder, dict):
        del holder[key]
        return f"{path} left out", json.dumps(value).encode()
    if rng.random() < 0.3:
        text = rng.choice(JSON_TEXTS)
        holder[key] = MARK
        return f"{path} = {text[:20]}", json.dumps(value).replace(json.dumps(MARK), text).encode(
            "utf-8", "surrogatepass"
        )
    holder[key] = rng.choice(JSON_VALUES)
    return f"{path} = {str(holder[key])[:30]}", json.dumps(value).encode()


def _json_places(value: Any, path: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield every value within a JSON value: where it is, what holds it, and its key there."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        yield f"{path}.{key}", value, key
        yield from _json_places(item, f"{path}.{key}")


PROTOBUF_CLASSES = {"/scan": LaserScan, "/tf": FrameTransform, "/tf_static": FrameTransforms}


def _wild_protobuf(rng: random.Random, topic: str, data: bytes) -> tuple[str, bytes]:
    if rng.random() < 0.4:
        return damaged_words(rng, data)
    message = PROTOBUF_CLASSES[topic].FromString(data)
    places = list(_protobuf_places(message))
    path, holder, field = rng.choice(places)
    value = getattr(holder, field.name)
    if _is_repeated(value):
        changed = rng.choice(([], [rng.choice(FLOATS) for _ in range(rng.choice(COUNTS))]))
        del value[:]
        value.extend(changed)
        return f"{path} = {len(changed)} items", message.SerializeToString()
    try:
        setattr(holder, field.name, wild_value(rng, value))
    except (ValueError, TypeError):
        setattr(holder, field.name, type(value)())
    return f"{path} = {getattr(holder, field.name)!r:.40}", message.SerializeToString()


def _is_repeated(value: Any) -> bool:
    return hasattr(value, "extend")


def _protobuf_places(message: Any, path: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield the fields of a protobuf message that are numbers, texts or sequences of numbers."""
    for field in message.DESCRIPTOR.fields:
        value = getattr(message, field.name)
        if field.message_type is None:
            yield f"{path}{field.name}", message, field
        elif _is_repeated(value):
            for item in value:
                yield from _protobuf_places(item, f"{path}{field.name}.")
        else:
            yield from _protobuf_places(value, f"{path}{field.name}.")
