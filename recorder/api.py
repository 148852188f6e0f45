"""The function that `import prim` offers for recordings."""

from __future__ import annotations

from pathlib import Path
from typing import Unpack

from prim.parameters import checked_keywords, checked_path, errors_name_parameters
from recorder.keywords import PARAMETERS, SWITCHES, RecordingKeywords, recording_options
from recorder.session import Session, record_session


def record(path: str | Path, **options: Unpack[RecordingKeywords]) -> Session:
    """Record a simulated session of a robot with a 2D LiDAR to an MCAP log.

    Args:
        path: The log to write.
        **options: The options of ``prim-record``, see :class:`recorder.keywords.RecordingKeywords`; angles are
            radians.

    Returns:
        What was recorded: ``world``, ``scans``, ``duration`` …

    Raises:
        UsageError: A parameter is impossible, or two exclude each other.
        WorldError: The file of the world is no world.
        OutputError: The log cannot be written.
    """
    with errors_name_parameters(PARAMETERS, SWITCHES):
        output = checked_path("path", path)
        return record_session(output, recording_options(**checked_keywords(RecordingKeywords, options)))
