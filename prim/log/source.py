"""A log as the rest of prim sees it, whatever format it has."""

from __future__ import annotations

from typing import NamedTuple


class Topic(NamedTuple):
    """One topic of a log: its name, message type, encoding and how many messages it has."""

    name: str
    type: str
    encoding: str
    messages: int


class Message(NamedTuple):
    """One message as it lies in the log: its topic, log time (ns) and bytes."""

    topic: str
    log_time: int
    data: bytes
