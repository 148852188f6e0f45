"""The function that `import prim` offers for recordings."""

from __future__ import annotations

from pathlib import Path
from typing import Unpack

from prim.parameters import checked_keywords, checked_path, errors_name_parameters
from recorder.keywords import PARAMETERS, SWITCHES, RecordingKeywords, recording_options
from recorder.session import Session, record_session


def record(path: str | Path, *, force: bool = False, **options: Unpack[RecordingKeywords]) -> Session:
    """Record a simulated session of a robot with a 2D LiDAR to an MCAP log.

    Args:
        path: The log to write.
        force: Whether a file in its place may be replaced that is no earlier recording.
        **options: The options of ``prim-record``, see :class:`recorder.keywords.RecordingKeywords`; angles are
            radians.

    Returns:
        What was recorded: ``world``, ``scans``, ``duration`` …

    Raises:
        UsageError: A parameter is impossible, two exclude each other, or there is another file in the log's place.
        WorldError: The file of the world is no world.
        OutputError: The log cannot be written.
    """
    with errors_name_parameters(PARAMETERS, {*SWITCHES, "force"}):
        output = checked_path("path", path)
        chosen = recording_options(**checked_keywords(RecordingKeywords, options, ("force",)))
        return record_session(output, chosen, force)
