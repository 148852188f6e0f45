"""How often a replay shows its map and detects primitives along the way, so that neither takes over."""

from __future__ import annotations

from dataclasses import dataclass

from replay.notes import pluralize
from replay.options import END, ReplayOptions

MAP_SNAPSHOTS = 50
"""By default the map is shown about this many times; set by hand."""

MAP_SNAPSHOT_CELLS = 40_000_000
"""By default no more cells than this are shown in all snapshots together: one byte each in a recording."""

DETECTIONS = 8
"""By default primitives are detected so many times at most, after the first and the last scan too. Set by hand: a
replay takes at most 40 % more time than with one detection at the end (`python -m bench.speed`)."""

DETECTED_CELLS = 3_000_000
"""By default no more cells than this are searched for primitives in all detections along the way: the time that these
take grows with the cells. Set by hand."""


@dataclass(frozen=True)
class Interval:
    """How often something is done along the way.

    Attributes:
        scans: Every how many scans; None for never.
        note: What a user should know of it; empty where nothing.
    """

    scans: int | None
    note: str = ""


NEVER = Interval(None)


def snapshot_interval(options: ReplayOptions, scans: int, cells: int) -> Interval:
    """Choose every how many scans the map is shown.

    Args:
        options: Options of the replay.
        scans: The number of scans.
        cells: The number of the map's cells.

    Returns:
        The interval; a note says where the map is too large to be shown often.
    """
    if options.map_every is not None:
        return Interval(options.map_every)
    times = min(MAP_SNAPSHOTS, max(1, MAP_SNAPSHOT_CELLS // cells))
    if times >= min(MAP_SNAPSHOTS, scans):
        return _spread(times, scans)
    often = f"the map is large and shown {pluralize(times, 'time')} along the way"
    more = _spread(min(2 * times, scans), scans).scans
    return _spread(times, scans, f"{often}: more often with --map-every {more}, or with a coarser --resolution")


def detection_interval(options: ReplayOptions, scans: int, cells: int, is_shown: bool) -> Interval:
    """Choose every how many scans primitives are detected before the last one.

    Args:
        options: Options of the replay.
        scans: The number of scans.
        cells: The number of cells of the map that the detector reads.
        is_shown: Whether the replay is shown.

    Returns:
        The interval; never for a detection after the last scan only. A note says where the map is too large for many
        detections.
    """
    if options.detect_every == END:
        return NEVER
    if options.detect_every is not None:
        return Interval(options.detect_every)
    if not is_shown:
        return NEVER
    most = DETECTIONS - 1  # and the one after the last scan
    times = min(most, DETECTED_CELLS // cells)
    times = 0 if times < min(2, scans) else times  # a single one, after the first scan, shows nothing
    if times >= min(most, scans):
        return _spread(times, scans)
    often = f"{pluralize(times, 'time')} along the way" if times else "at the end only"
    more = _spread(min(2 * max(times, 1), scans), scans).scans
    return _spread(
        times, scans, f"the map is large, and primitives are detected {often}: more often with --detect-every {more}"
    )


def is_due(position: int, interval: int) -> bool:
    """Return whether a detection is due.

    Args:
        position: The latest scan's position in the selection.
        interval: The interval, in scans.

    Returns:
        True after the first scan, and after every ``interval`` scans.
    """
    return position == 0 or (position + 1) % interval == 0


def _spread(times: int, scans: int, note: str = "") -> Interval:
    """Spread ``times`` evenly over the scans."""
    return Interval(max(1, -(-scans // times)) if times else None, note)
