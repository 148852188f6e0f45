"""The options of a replay by keyword, as the command line and the API give them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, TypedDict, Unpack

from prim.errors import UsageError
from prim.se2 import Pose2D
from prim.world import Bounds
from replay.options import ReplayOptions
from replay.poses.fusion_options import SENSORS, FusionInputs, SensorNoise
from replay.scans.selection import Selection


class ReplayKeywords(TypedDict, total=False):
    """What may be given of a replay; what is not given, or None, is as on the command line.

    Lengths are metres, angles radians, times seconds. :class:`replay.options.ReplayOptions` and
    :class:`replay.scans.selection.Selection` say what each means; the rest is described here.
    """

    mapper: str | Sequence[str]
    """One mapper, or several: a list, or separated by commas."""
    sensor_model: str
    noise_std: float | None
    pose: str
    resolution: float
    bounds: Bounds | None
    scan_topic: str | Sequence[str] | None
    """The topic of scans, or several: a list, or separated by commas."""
    clock: str
    height_slice: tuple[float, float] | None
    odom_topic: str | None
    laser_offset: tuple[float, float, float] | Pose2D | None
    """The laser's pose on the robot: x, y (m), heading (rad)."""
    max_range: float | None
    max_memory: float | None
    standing_still: bool
    fuse: Sequence[str] | str | None
    """The sensors to fuse, of «odom», «gps», «compass», «imu»: a list, or separated by commas."""
    gps_topic: str | None
    compass_topic: str | None
    imu_topic: str | None
    pose_noise: tuple[float, float] | None
    """Standard deviations of GPS positions (m) and compass headings (rad)."""
    odom_noise: tuple[float, float] | None
    """Standard deviations of the odometry's position (m) and heading (rad) after one metre."""
    match_scans: bool
    deskew: bool
    sweep: str
    start: float | None
    end: float | None
    duration: float | None
    n_scans: int | None
    stride: int
    rate: float | None
    map_every: int | None
    detect: bool
    detect_every: int | Literal["end"] | None
    refine: bool
    sizes: tuple[float, float]
    """The smallest and the largest object that is searched for (m), by its longest side or its diameter."""
    closed_world: bool
    weights: str | Path | None
    recover: bool


PARAMETERS = frozenset(ReplayKeywords.__annotations__)
"""The names of all keywords."""

SWITCHES = frozenset({"standing_still", "match_scans", "deskew", "detect", "refine", "closed_world", "recover"})
"""Those that are true or false."""

_SELECTION = ("start", "end", "duration", "n_scans", "stride")
_FUSION = ("fuse", "gps_topic", "compass_topic", "imu_topic", "pose_noise", "odom_noise")


def replay_options(**keywords: Unpack[ReplayKeywords]) -> ReplayOptions:
    """Make the options of a replay.

    Args:
        **keywords: See :class:`ReplayKeywords`.

    Returns:
        The options.

    Raises:
        UsageError: A value is impossible, or two exclude each other.
    """
    given = {name: value for name, value in keywords.items() if value is not None}
    selection = Selection(**{name: given.pop(name) for name in _SELECTION if name in given})  # type: ignore[arg-type]
    fuse = _fusion_inputs(**{name: given.pop(name) for name in _FUSION if name in given})  # type: ignore[arg-type]
    if "mapper" in given:
        given["mapper"] = ",".join(_listed(given["mapper"]))  # type: ignore[arg-type]
    if "scan_topic" in given:
        given["scan_topic"] = _listed(given["scan_topic"])  # type: ignore[arg-type]
    if "laser_offset" in given:
        given["laser_offset"] = _as_pose(given["laser_offset"])  # type: ignore[arg-type]
    if "weights" in given:
        given["weights"] = Path(given["weights"])  # type: ignore[arg-type]
    return ReplayOptions(selection=selection, fuse=fuse, **given)  # type: ignore[arg-type]


def _fusion_inputs(
    fuse: Sequence[str] | str | None = None,
    gps_topic: str | None = None,
    compass_topic: str | None = None,
    imu_topic: str | None = None,
    pose_noise: tuple[float, float] | None = None,
    odom_noise: tuple[float, float] | None = None,
) -> FusionInputs:
    """Return what poses are fused from, and its noise. Raises UsageError."""
    names = SENSORS if fuse is None else _listed(fuse)
    unknown = [name for name in names if name not in SENSORS]
    if unknown:
        raise UsageError(
            f"--fuse {','.join(names)}: {unknown[0] or 'an empty name'} is no sensor; they are {', '.join(SENSORS)}"
        )
    if compass_topic is not None and imu_topic is not None:
        raise UsageError("--compass-topic excludes --imu-topic: headings come from one sensor")
    noise = SensorNoise(*(pose_noise or (None, None)), *(odom_noise or (None, None)))
    return FusionInputs(tuple(name for name in SENSORS if name in names), gps_topic, compass_topic, imu_topic, noise)


def _listed(names: Sequence[str] | str) -> tuple[str, ...]:
    """Return names that are given as a list, or separated by commas."""
    return tuple(name.strip() for name in (names.split(",") if isinstance(names, str) else names))


def _as_pose(offset: tuple[float, float, float] | Pose2D) -> Pose2D:
    return offset if isinstance(offset, Pose2D) else Pose2D(*offset)
