"""JSON that a log brings along: worlds, the texts of markers, the metadata record of the recorder."""

from __future__ import annotations

import json
import random
from typing import Any

from mcap.records import Attachment, Channel, Metadata, Schema

from bench.fuzzing.case import Case
from bench.fuzzing.foxglove_messages import JSON_TEXTS, JSON_VALUES, wild_foxglove_json, wild_json
from bench.fuzzing.mcap_file import Assembly
from bench.fuzzing.messages import message_record, ros2_types
from bench.fuzzing.samples import Samples
from prim.log.messages import TRUE_PRIMITIVES_TOPIC

MANY_PRIMITIVES = (1_000, 100_000)
MODES = (
    "--no-detect --mapper det",
    "--no-detect --mapper prob",
    "--no-detect --mapper det --pose odom",
    "--mapper prob",
)
"""Options with which such logs are replayed; only the last one compares what is found with the primitives."""
NUMBERS = (
    "1e999",
    "-1",
    "0",
    "NaN",
    "9" * 400,
    "1e308",
    "true",
    "null",
    "[]",
    "{}",
    '"0.05"',
    "",
    "\x1b[2J",
    "0.05\n",
    " 1 ",
)
"""Values of the recorder's metadata, which are texts."""


def hostile_json(rng: random.Random, samples: Samples) -> Case:
    """Make a log with odd JSON in one of its documents.

    Args:
        rng: The source of randomness.
        samples: The intact logs.

    Returns:
        The case.
    """
    options = ("--no-viewer", *rng.choice(MODES).split())
    if rng.random() < 0.25:
        what, data = wild_foxglove_json(rng, samples)
        return Case(what, {"log.mcap": data}, options=options)
    content = samples.content
    world, metadata = content.attachments["world.json"], dict(content.metadata["prim"])
    messages = list(content.messages)
    document = rng.choice(("world", "world", "metadata", "markers"))
    if document == "world":
        what, world = _wild_world(rng, world)
    elif document == "metadata":
        what, metadata = _wild_metadata(rng, metadata)
    else:
        at = next(k for k, message in enumerate(messages) if message.topic == TRUE_PRIMITIVES_TOPIC)
        what, data = _wild_markers(rng, messages[at].data)
        messages[at] = messages[at]._replace(data=data)
    file = Assembly()
    file.add(Metadata(metadata=metadata, name="prim"))
    file.add(Attachment(create_time=0, log_time=0, name="world.json", media_type="application/json", data=world))
    for number, (topic, kind) in enumerate(content.types.items(), 1):
        file.add(Schema(id=number, data=b"", encoding="ros2msg", name=kind))
        file.add(Channel(id=number, topic=topic, message_encoding="cdr", metadata={}, schema_id=number))
    numbers = {topic: number for number, topic in enumerate(content.types, 1)}
    file.add(*(message_record(numbers[m.topic], m.log_time, m.data) for m in messages))
    return Case(f"{document}: {what}", {"log.mcap": file.finish()}, options=options)


def _wild_world(rng: random.Random, data: bytes) -> tuple[str, bytes]:
    if rng.random() < 0.75:
        return wild_json(rng, "it", data)
    world = json.loads(data)
    count = rng.choice(MANY_PRIMITIVES)
    how = rng.choice(("primitives", "walls", "clutter"))
    world[how] = [rng.choice(world[how])] * count
    return f"{count} {how}", json.dumps(world).encode()


def _wild_metadata(rng: random.Random, metadata: dict[str, str]) -> tuple[str, dict[str, str]]:
    key = rng.choice(list(metadata))
    how = rng.random()
    if how < 0.2:
        del metadata[key]
        return f"{key} left out", metadata
    if how < 0.6:
        metadata[key] = rng.choice((*NUMBERS, *JSON_TEXTS)).encode("utf-8", "replace").decode()
    else:
        try:
            metadata[key] = wild_json(rng, key, metadata[key].encode())[1].decode("utf-8", "replace")
        except (ValueError, IndexError):  # it is a plain text
            metadata[key] = json.dumps(rng.choice(JSON_VALUES))
    return f"{key} = {metadata[key][:40]!r}", metadata


def _wild_markers(rng: random.Random, data: bytes) -> tuple[str, bytes]:
    kind = "visualization_msgs/msg/MarkerArray"
    markers: Any = ros2_types().deserialize_cdr(data, kind)
    own = [marker for marker in markers.markers if marker.ns == "primitives"]
    marker = rng.choice(own)
    if rng.random() < 0.15:
        markers.markers = [marker] * rng.choice((1_000, 5_000))
        return f"{len(markers.markers)} markers", bytes(ros2_types().serialize_cdr(markers, kind))
    what, text = wild_json(rng, "text", marker.text.encode())
    marker.text = text.decode("utf-8", "replace")
    return what, bytes(ros2_types().serialize_cdr(markers, kind))
