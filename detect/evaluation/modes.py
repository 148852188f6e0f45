"""Modes of recording that the shipped weights are evaluated with; imports nothing, for the command line."""

from __future__ import annotations

from enum import StrEnum


class RecordingMode(StrEnum):
    """How sessions are recorded: the standard way, and variations of it."""

    WARPED = "warped"
    DRIVEN = "driven"
    NO_WALLS = "no walls"
    FEW_RAYS = "180 rays"
    MANY_RAYS = "1000 rays"
