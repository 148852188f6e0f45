"""Which topics of a log hold the scans that are replayed."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from itertools import pairwise

from prim.errors import LogReadError
from prim.log.decoding.codecs import SCAN_CONTENTS, Content
from prim.log.source import LogSource, Topic
from prim.text import listed
from replay.poses.transforms import TransformTree

MOST_SCANNERS = 32
"""A robot carries no more scanners; set by hand."""


def choose_scan_topics(log: LogSource, wanted: Sequence[str]) -> tuple[list[Topic], tuple[str, ...]]:
    """Choose the topics of scans that are mapped together.

    Args:
        log: The log.
        wanted: The names of the topics; none: those of all scanners that one robot carries. Clouds are taken only
            where there are no scans.

    Returns:
        The topics, and notes of what was assumed.

    Raises:
        LogReadError: A topic has no scans, or there are several to choose from.
    """
    if wanted:
        return [_requested(log, name) for name in dict.fromkeys(wanted)], ()
    topics = log.holding(Content.SCAN) or log.holding(Content.CLOUD)
    if not topics:
        raise _without_scans(log)
    if len(topics) == 1:
        return topics, ()
    names = listed(topic.name for topic in topics)
    if _carried_by_one_robot(log, topics):
        note = (
            f"{len(topics)} scanners of one robot are mapped together ({names}); for one of them give --scan-topic "
        )
        return topics, (note + shlex.quote(topics[0].name),)
    hint = f"choose one with --scan-topic {shlex.quote(topics[0].name)}, or more by giving it again"
    raise LogReadError(log.path, f"{len(topics)} scan topics: {names}", hint)


def _requested(log: LogSource, name: str) -> Topic:
    topics = log.holding(*SCAN_CONTENTS)
    chosen = next((topic for topic in topics if topic.name == name), None)
    if chosen is not None:
        return chosen
    hint = f"its scan topics: {listed(topic.name for topic in topics)}" if topics else listing(log)
    is_empty = name in log.topics and log.topics[name].content in SCAN_CONTENTS
    raise LogReadError(log.path, f"no messages on {name}" if is_empty else f"no LaserScan on {name}", hint)


def _without_scans(log: LogSource) -> LogReadError:
    empty = [topic.name for topic in log.topics.values() if topic.content in SCAN_CONTENTS]
    if empty:
        return LogReadError(log.path, f"no messages on {listed(empty)}", "; ".join(log.lost))
    return LogReadError(log.path, "no LaserScan in this log", listing(log))


def _carried_by_one_robot(log: LogSource, topics: Sequence[Topic]) -> bool:
    """Return whether the scanners have frames of their own that static transforms join."""
    if len(topics) > MOST_SCANNERS:
        return False
    try:
        frames = [next(iter(log.decoded(topic)))[1].frame_id.lstrip("/") for topic in topics]
        tree = TransformTree.read(log, static_only=True)
    except (LogReadError, StopIteration):
        return False
    roots = [tree.chain(frame)[-1] for frame in frames]
    joined = all(a == b for a, b in pairwise(roots)) and len(set(frames)) == len(frames)
    return joined and all(frame in tree.edges or frame == roots[0] for frame in frames)


def listing(log: LogSource) -> str:
    """Return the log's topics and what was lost, as a hint."""
    topics = sorted(log.topics.values(), key=lambda topic: topic.name)
    names = listed(f"{topic.name} ({topic.type or topic.encoding})" for topic in topics)
    return "; ".join([f"its topics: {names}" if names else "it has no topics at all", *log.lost])
