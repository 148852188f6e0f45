"""What a log holds, and what a replay would use of it: ``prim-replay --list``."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from prim.errors import LogReadError
from prim.log import open_log
from prim.log.decoding.codecs import Content
from prim.log.source import LogSource, Topic
from replay.localization import choose_poses
from replay.options import ReplayOptions
from replay.poses.transforms import TransformTree
from replay.scans.scan_log import ScanLog
from replay.timing import StageTimer

SCHEMA = "prim-list/1"

SECOND = 1_000_000_000
"""Nanoseconds."""

MOST_DESCRIBED = 300
"""The messages of so many topics are read for their frames and their lag; a robot has no more of use here."""

SAMPLED = 2000
"""The clock of a topic is found from this many of its first messages."""


SHOWN_FRAMES = 12
"""The table names no more transforms."""

FAR_LAG = 1e4
"""Stamps that differ more (s) from when messages were logged are on another clock."""


@dataclass(frozen=True)
class TopicSummary:
    """What a log holds on one topic.

    Attributes:
        topic: The topic.
        first: When its first message was logged (s after the log's first); None without a message.
        last: The same of the last one.
        rate: Messages per second; None where there are fewer than two.
        frames: The frames that its messages name.
        lag: How long after the stamps of their headers messages are logged (s, the median); None without a stamp.
    """

    topic: Topic
    first: float | None
    last: float | None
    rate: float | None
    frames: tuple[str, ...]
    lag: float | None


@dataclass(frozen=True)
class Choice:
    """What a replay would use.

    Attributes:
        source: The topics or frames; None where there is nothing.
        why: Why these, or why there is nothing.
    """

    source: str | None
    why: str


@dataclass(frozen=True)
class LogSummary:
    """What a log holds, and what a replay would use of it.

    Attributes:
        path: The log.
        format: Its format.
        duration: From the first to the last message (s).
        topics: Its topics, sorted by name.
        scans: What scans would be made of.
        poses: Where poses would come from.
        notes: What is odd, and what would be assumed.
        lost: What could not be read.
    """

    path: Path
    format: str
    duration: float
    topics: tuple[TopicSummary, ...]
    scans: Choice
    poses: Choice
    notes: tuple[str, ...]
    lost: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """Return the summary as JSON values (schema ``prim-list/1``, docs/formats.md)."""
        return {
            "schema": SCHEMA,
            "path": str(self.path),
            "format": self.format,
            "duration_s": self.duration,
            "topics": [
                {
                    "name": row.topic.name,
                    "type": row.topic.type,
                    "encoding": row.topic.encoding,
                    "holds": row.topic.content and str(row.topic.content),
                    "messages": row.topic.messages,
                    "first_s": row.first,
                    "last_s": row.last,
                    "rate_hz": row.rate,
                    "frames": list(row.frames),
                    "lag_s": row.lag,
                }
                for row in self.topics
            ],
            "scans": {"source": self.scans.source, "why": self.scans.why},
            "poses": {"source": self.poses.source, "why": self.poses.why},
            "notes": list(self.notes),
            "lost": list(self.lost),
        }


def summarize_log(path: Path, options: ReplayOptions) -> LogSummary:
    """Find out what a log holds, and what a replay would use of it.

    Args:
        path: The log.
        options: Options of the replay.

    Returns:
        The summary.

    Raises:
        LogReadError: The log cannot be read.
        UsageError: The options do not fit the log.
    """
    with open_log(path, recover=options.recover) as log:
        times = _logged_times(log)
        start = min((first for first, _ in times.values()), default=0)
        end = max((last for _, last in times.values()), default=0)
        topics = sorted(log.topics.values(), key=lambda topic: topic.name)
        described = {topic.name for topic in [topic for topic in topics if topic.content][:MOST_DESCRIBED]}
        rows = tuple(
            _summarize_topic(log if topic.name in described else None, topic, times.get(topic.name), start)
            for topic in topics
        )
        scans, poses, notes = _choices(log, options)
        if sum(topic.content is not None for topic in topics) > MOST_DESCRIBED:
            notes = (*notes, f"the frames and the lag of the first {MOST_DESCRIBED} topics are shown, of no others")
        duration = (end - start) / SECOND
        return LogSummary(path, log.format, duration, rows, scans, poses, notes, tuple(log.lost))


def _logged_times(log: LogSource) -> Mapping[str, tuple[int, int]]:
    """Return when the first and the last message of each topic were logged (ns)."""
    found: dict[str, tuple[int, int]] = {}
    for message in log.messages(*log.topics):
        first, last = found.get(message.topic, (message.log_time, message.log_time))
        found[message.topic] = min(first, message.log_time), max(last, message.log_time)
    return found


def _summarize_topic(log: LogSource | None, topic: Topic, times: tuple[int, int] | None, start: int) -> TopicSummary:
    """Describe a topic; its frames and its lag only with the log that it is of."""
    if times is None:
        return TopicSummary(topic, None, None, None, (), None)
    first, last = times
    rate = (topic.messages - 1) * SECOND / (last - first) if last > first and topic.messages > 1 else None
    frames: tuple[str, ...] = ()
    lag = None
    if log is not None:
        with suppress(LogReadError):  # a choice of it, or --recover, says so
            frames, lag = tuple(_frames(log, topic)), _lag(log, topic)
    return TopicSummary(topic, (first - start) / SECOND, (last - start) / SECOND, rate, frames, lag)


def _frames(log: LogSource, topic: Topic) -> Iterator[str]:
    """Yield the frames that messages of a topic name: of transforms all, else those of the first one."""
    if topic.content is Content.TRANSFORMS:
        edges: defaultdict[str, list[str]] = defaultdict(list)
        for child, (parent, _) in TransformTree.read_topic(log, topic).edges.items():
            edges[parent].append(child)
        yield from (f"{parent} > {child}" for parent in edges for child in edges[parent])
    elif topic.content is not None and topic.content is not Content.PRIMITIVES:
        value = next((value for _, value in log.decoded(topic) if value != []), None)
        if value is None:  # none of its messages can be decoded
            return
        message = value[0] if isinstance(value, list) else value
        names = (message.frame_id, getattr(message, "child_frame_id", ""))
        yield " > ".join(name or "(no name)" for name in names[: 2 if names[1] else 1])


def _lag(log: LogSource, topic: Topic) -> float | None:
    if topic.content is None:
        return None
    lags = []
    for message in log.stamps(topic):
        lags.append(message.log_time - message.value)
        if len(lags) == SAMPLED:
            break
    return float(np.median(lags)) / SECOND if lags else None


def _choices(log: LogSource, options: ReplayOptions) -> tuple[Choice, Choice, tuple[str, ...]]:
    """Return what scans and poses a replay would use, and the notes that it would give."""
    try:
        scans = ScanLog(log, options.selection, options.scan_log)
    except LogReadError as error:
        return Choice(None, _reason(error)), Choice(None, "there are no scans"), ()
    given = bool(options.scan_topic)
    kinds = ", ".join(dict.fromkeys(topic.type for topic in scans.topics))
    why = (
        "given by --scan-topic"
        if given
        else f"all scanners of one robot, {kinds}"
        if len(scans.topics) > 1
        else kinds
    )
    try:
        found = choose_poses(scans, options, StageTimer())
    except LogReadError as error:
        return Choice(scans.names, why), Choice(None, _reason(error)), tuple(scans.notes())
    notes = (*found.notes, *found.poses.notes, *scans.notes())
    return (
        Choice(scans.names, why),
        Choice(found.poses.origin, SOURCES[found.poses.source]),
        tuple(dict.fromkeys(notes)),
    )


SOURCES = {
    "truth": "the ground truth",
    "tf": "a chain of transforms",
    "odom": "the poses on a topic",
    "fused": "fused from several sensors",
    "scans": "found by the scans alone",
    "still": "the robot is taken to stand still",
}
"""What the sources of poses are."""


def _reason(error: LogReadError) -> str:
    return f"{error.what}; {error.hint}" if error.hint else error.what


def topic_table(summary: LogSummary) -> list[list[str]]:
    """Return the table of a log's topics: a head, and a row for each."""
    return [["topic", "type", "messages", "rate", "from", "to", "lag"], *(_row(row) for row in summary.topics)]


def _row(row: TopicSummary) -> list[str]:
    topic = row.topic
    package, _, kind = (topic.type or "?").rpartition("/")
    if package and topic.content is None:  # of others the name alone does not say what they are
        kind = f"{package.removesuffix('/msg')}/{kind}"
    return [
        topic.name,
        kind if topic.encoding in ("cdr", "carmen") else f"{kind} ({topic.encoding})",
        f"{topic.messages}",
        f"{row.rate:.1f} Hz" if row.rate else "",
        "" if row.first is None else f"{row.first:.1f} s",
        "" if row.last is None else f"{row.last:.1f} s",
        "" if row.lag is None else "far" if abs(row.lag) > FAR_LAG else f"{row.lag:.3f} s",
    ]


def summary_rows(summary: LogSummary) -> list[tuple[str, str]]:
    """Return what is to be said of a log beside its topics: name and value."""
    of_topics = [
        f"{row.topic.name} in {row.frames[0]}"
        for row in summary.topics
        if row.frames and row.topic.content is not Content.TRANSFORMS
    ]
    edges = [edge for row in summary.topics if row.topic.content is Content.TRANSFORMS for edge in row.frames]
    more = f", and {len(edges) - SHOWN_FRAMES} more" if len(edges) > SHOWN_FRAMES else ""
    return [
        ("log", f"{summary.path.name}, {summary.format}, {summary.duration:.1f} s"),
        ("frames", "; ".join(of_topics) or "none"),
        ("transforms", (", ".join(edges[:SHOWN_FRAMES]) or "none") + more),
        ("scans", f"{summary.scans.source or 'none'} ({summary.scans.why})"),
        ("poses", f"{summary.poses.source or 'none'} ({summary.poses.why})"),
    ]
