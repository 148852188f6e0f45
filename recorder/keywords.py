"""The options of a recording by keyword, as the command line and the API give them."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypedDict, Unpack

from prim.errors import UsageError
from prim.shapes import Kind
from recorder.faults import DROPOUT_VALUES, ScannerFaults
from recorder.odometry import OdometryNoise
from recorder.rooms import ELEMENTS, SHAPES
from recorder.sensors import Compass, Gps, Lidar
from recorder.session import SessionOptions
from recorder.world import WorldOptions

PAPER_NOISE_UNIT = 5.0
"""``noise=1`` is a standard deviation of this many metres (the paper's IV-A)."""

MIN_RATE, MAX_RATE = 1e-3, 1e6
"""Scans per second; beyond, stamps in whole ns run into each other or out of their range."""

MAX_LENGTH = 1e6
"""Floors and ranges (m) are no larger: float32 ranges would be off by more than centimetres."""

LARGEST = {
    "noise": 1e3,
    "noise_std": 1e3,
    "range_bias": 1e3,
    "quantum": 1e2,
    "dropout": 1.0,
    "outliers": 1.0,
    "noise_growth": 1e2,
    "gps_noise": 1e6,
    "compass_noise": 1e3,
    "odom_noise": 1e3,
    "speed": 10.0,
    "rays": 1e6,
    "per_kind": 1e4,
    "clutter": 1e3,
    "at_walls": 1e3,
    "stops": 1e5,
    "arena": MAX_LENGTH,
    "sizes": 1e3,
    "range_min": MAX_LENGTH,
    "range_max": MAX_LENGTH,
}
"""The largest value of each option (m, rad, m/s, or a number); set by hand."""

SMALLEST = {"arena": 1e-2, "sizes": 1e-2, "speed": 1e-4}
"""The smallest value of options (m, m/s) that else need only be above 0; set by hand."""

MAX_BEAM_WIDTH = math.radians(30)
"""A beam is no wider (rad); set by hand."""

MAX_SHOWN = 10**300
"""Whole numbers beyond are not written out."""

MAX_SECONDS = 1e8
"""No session is longer (s): stamps count seconds in 32 bits. Set by hand."""

FULL_TURN, ROUNDING = 2 * math.pi, 1e-9

ALL_KINDS = "all"

BOX_ROOM = "box"
"""The room that is nothing but the walls along the floor's edges."""


class RecordingKeywords(TypedDict, total=False):
    """What may be given of a recording; what is not given, or None, is as on the command line.

    Lengths are metres, angles radians, times seconds.
    """

    seed: int
    """The same seed and options write the same bytes."""
    world: str | Path | None
    """A file that describes the world; it excludes all that is drawn, from arena to touching."""
    arena: tuple[float, float] | None
    """The floor, along x and y."""
    walls: bool | None
    """Whether there is a wall along each edge of the floor."""
    kinds: Sequence[str] | str | None
    """The kinds of primitives to draw: a list, or separated by commas; or «all»."""
    per_kind: int | tuple[int, int] | None
    """How many of each kind: a number, or fewest and most."""
    sizes: tuple[float, float] | None
    """The smallest and the largest extent of primitives and clutter (longest side, diameter), all scales alike."""
    clutter: int | tuple[int, int] | None
    """How many things that are none of the kinds: a number, or fewest and most."""
    room: Sequence[str] | str | None
    """What the room is and has: «box», «round», «corridor» or «L»; «doorways», «pilasters», «furniture»; a list, or
    separated by commas."""
    at_walls: float | None
    """How far from a wall every primitive stands; 0: it touches it."""
    touching: bool
    """Whether primitives stand in pairs that touch each other; it excludes at_walls."""
    motion: str
    """«warp»: the robot is set on a grid of positions; «drive»: it drives."""
    stops: tuple[int, int] | None
    """Columns and rows of the grid of positions."""
    duration: float | None
    """How long it drives."""
    speed: float | None
    """How fast it drives (m/s)."""
    movable: bool
    """Whether a driving robot can push the primitives."""
    odom_noise: tuple[float, float] | None
    """Standard deviations of the odometry's position (m) and heading (rad) after one metre."""
    rate: float
    """Scans per second."""
    rays: int
    """Beams in a scan."""
    fov: float
    """Field of view (rad)."""
    range_min: float
    range_max: float
    noise: float | None
    """Standard deviation of the range noise as a share of 5 m, the paper's unit."""
    noise_std: float | None
    """Standard deviation of the range noise (m); it excludes noise."""
    range_bias: float
    """What is added to each range."""
    beam_width: float
    """Full angular width of a beam (rad); at edges it lights several surfaces."""
    quantum: float
    """Ranges are rounded to whole multiples of this."""
    dropout: float
    """The share of beams that return nothing."""
    dropout_as: str | None
    """What is written for them: «inf», «nan», «0», or «max», the longest range."""
    outliers: float
    """The share of beams whose range is uniform between the limits."""
    noise_growth: float
    """Standard deviation of a further noise per metre of distance."""
    gps_noise: float
    """Standard deviation of GPS positions (m)."""
    compass_noise: float
    """Standard deviation of compass headings (rad)."""


PARAMETERS = frozenset(RecordingKeywords.__annotations__)
"""The names of all keywords."""

SWITCHES = frozenset({"walls", "movable", "touching"})
"""Those that are true or false."""


def recording_options(**keywords: Unpack[RecordingKeywords]) -> SessionOptions:
    """Make the options of a recording.

    Args:
        **keywords: See :class:`RecordingKeywords`.

    Returns:
        The options.

    Raises:
        UsageError: A value is impossible, or two exclude each other.
    """
    given: dict[str, Any] = {name: value for name, value in keywords.items() if value is not None}
    _check_combinations(given)
    _check_values(given)
    converted = {name: convert(given[name]) for name, convert in _CONVERTED.items() if name in given}
    if "noise" in given:
        given["noise_std"] = PAPER_NOISE_UNIT * given["noise"]
    options = SessionOptions(
        world=WorldOptions(**_drawn({**given, **converted})),
        lidar=Lidar(**_some(given, _LIDAR), faults=_faults(given)),
        **_some(given, _DIRECT),
        **{_FIELDS[name]: value for name, value in converted.items() if name in _FIELDS},
    )
    _check_scanner(options)
    return options


def _drawn(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return what is given of a drawn world, by the fields of its options."""
    return {"size" if name == "arena" else name: value for name, value in _some(given, _DRAWN).items()}


def _faults(given: Mapping[str, Any]) -> ScannerFaults:
    """Make the scanner's faults."""
    written = given.get("dropout_as")
    if written is not None and written not in DROPOUT_VALUES:
        raise UsageError(f"--dropout-as {written}: it is one of {', '.join(DROPOUT_VALUES)}")
    if written is not None and not given.get("dropout"):
        raise UsageError("--dropout-as needs --dropout, above 0")
    bias = given.get("range_bias", 0.0)
    if not abs(bias) <= LARGEST["range_bias"]:
        largest = LARGEST["range_bias"]
        raise UsageError(f"--range-bias is {bias:g}: it must be from -{largest:g} to {largest:g}")
    named = {_FAULTS[name]: given[name] for name in _FAULTS if name in given}
    return ScannerFaults(**named)


def _some(given: Mapping[str, Any], names: Collection[str]) -> dict[str, Any]:
    """Return what is given of some parameters."""
    return {name: given[name] for name in names if name in given}


def _check_combinations(given: Mapping[str, Any]) -> None:
    """Raise UsageError where parameters exclude each other."""
    motion = given.get("motion", SessionOptions.motion)
    if motion not in ("warp", "drive"):
        raise UsageError(f"--motion {motion}: it is warp or drive")
    drawn = [name for name in _DRAWN if name in given and (name != "touching" or given[name])]
    if "world" in given and drawn:
        raise UsageError(
            f"--world excludes {'--no-walls' if drawn[0] == 'walls' else _option(drawn[0])}: the file says it all"
        )
    _check_walls(given)
    _refuse(given, _WARPED if motion == "drive" else _DRIVEN, motion)
    if "noise" in given and "noise_std" in given:
        raise UsageError("--noise and --noise-std say the same in two units: give one of them")


def _check_walls(given: Mapping[str, Any]) -> None:
    """Raise UsageError where a world is to be drawn that cannot be."""
    if given.get("at_walls") is not None and given.get("touching"):
        raise UsageError("--at-walls and --touching exclude each other")
    smallest, largest = given.get("sizes", (1.0, 1.0))
    if not smallest <= largest:
        raise UsageError(
            f"--sizes is {smallest:g} {largest:g}: give the smaller one first: --sizes {largest:g} {smallest:g}"
        )
    for name in ("room", "at_walls"):
        if name in given and given.get("walls") is False:
            raise UsageError(f"{_option(name)} does not go with --no-walls")


def _refuse(given: Mapping[str, Any], names: Collection[str], motion: str) -> None:
    """Raise UsageError where a parameter is given that does not go with the motion."""
    wrong = [name for name in names if given.get(name)]
    if wrong:
        raise UsageError(f"{_option(wrong[0])} does not go with --motion {motion}")


def _check_values(given: Mapping[str, Any]) -> None:
    """Raise UsageError where a number is out of its range."""
    for name, least in (*((name, None) for name in _POSITIVE), *((name, 0) for name in _NOT_NEGATIVE)):
        if name not in given:
            continue
        values = given[name] if isinstance(given[name], Sequence) else [given[name]]
        for value in values:
            if not -math.inf < value < math.inf or value < 0 or (least is None and value == 0):
                raise UsageError(
                    f"{_option(name)} is {value:g}: it must {'be above' if least is None else 'not be below'} 0"
                )
            if not SMALLEST.get(name, 0) <= value <= LARGEST.get(name, math.inf):
                allowed = f"from {SMALLEST.get(name, 0):g} to {LARGEST.get(name, math.inf):g}"
                raise UsageError(f"{_option(name)} is {_plain(value)}: it must be {allowed}")


def _plain(value: float) -> str:
    """Return a number as a message shows it, whole ones too large for a float among them."""
    return f"{value:g}" if abs(value) < MAX_SHOWN else "a number beyond any use"


def _check_scanner(options: SessionOptions) -> None:
    """Raise UsageError for a floor or a scanner that cannot be."""
    lidar, rate = options.lidar, options.rate
    if lidar.range_min >= lidar.range_max:
        raise UsageError(f"--range-min {lidar.range_min:g} is not below --range-max {lidar.range_max:g}")
    if not MIN_RATE <= rate <= MAX_RATE:
        raise UsageError(f"--rate is {rate:g}: it must be from {MIN_RATE:g} to {MAX_RATE:.0f} scans per second")
    scans = options.stops[0] * options.stops[1] if options.motion == "warp" else options.duration * rate
    if scans / rate > MAX_SECONDS:
        what = "--duration" if options.motion == "drive" else "--stops over --rate"
        raise UsageError(f"{what} gives a session of {scans / rate:g} s: it must not be above {MAX_SECONDS:g} s")
    if (width := lidar.faults.beam_width) > MAX_BEAM_WIDTH:
        said = f"{math.degrees(width):g} degrees, {width:g} rad"
        raise UsageError(f"--beam-width is {said}: it must be from 0 to {math.degrees(MAX_BEAM_WIDTH):g} degrees")
    if lidar.fov > FULL_TURN * (1 + ROUNDING):
        turn = f"{math.degrees(lidar.fov):g} degrees, {lidar.fov:g} rad"
        raise UsageError(f"--fov is more than a full turn: {turn}")


def _kinds(listed: Sequence[str] | str) -> tuple[Kind, ...]:
    if isinstance(listed, str):
        listed = [*Kind] if listed == ALL_KINDS else [name.strip() for name in listed.split(",") if name.strip()]
    unknown = [name for name in listed if name not in [*Kind]]
    if unknown or not listed:
        what = f"{', '.join(unknown)} is no kind" if unknown else "it names no kind"
        raise UsageError(f"--kinds {','.join(listed)}: {what}; the kinds are {','.join(Kind)}")
    return tuple(Kind(name) for name in listed)


def _room(listed: Sequence[str] | str) -> tuple[str, ...]:
    """Return the names of what a room has beside its outer walls, in the order in which it is drawn."""
    names = [name.strip() for name in (listed.split(",") if isinstance(listed, str) else listed)]
    known = (BOX_ROOM, *SHAPES, *ELEMENTS)
    unknown = [name for name in names if name not in known]
    if unknown or not names:
        what = f"{', '.join(unknown) or 'nothing'} is nothing of a room"
        raise UsageError(f"--room {','.join(names)}: {what}, which is or has {','.join(known)}")
    shapes = [name for name in known if name in names and name not in ELEMENTS]
    if len(shapes) > 1:
        raise UsageError(f"--room {','.join(names)}: a room is one of {','.join(known[: len(SHAPES) + 1])}")
    return tuple(name for name in known if name in names and name != BOX_ROOM)


def _counts(name: str, counts: int | tuple[int, int]) -> tuple[int, int]:
    fewest, most = (counts, counts) if isinstance(counts, int) else counts
    if not 0 <= fewest <= most:
        raise UsageError(f"{_option(name)} {fewest}-{most} is not a range from small to large")
    if most > LARGEST[name]:
        raise UsageError(f"{_option(name)} is {_plain(most)}: it must be from 0 to {LARGEST[name]:g}")
    return fewest, most


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


_DRAWN = ("arena", "walls", "kinds", "per_kind", "sizes", "clutter", "room", "at_walls", "touching")
_DRIVEN = ("duration", "speed", "movable", "odom_noise")
_WARPED = ("stops",)
_LIDAR = ("rays", "fov", "range_min", "range_max", "noise_std")
_FAULTS = {
    **{name: name for name in ("range_bias", "beam_width", "quantum", "dropout_as", "outliers", "noise_growth")},
    "dropout": "dropouts",
}
"""The fields of the scanner's faults by the names of their parameters."""
_DIRECT = ("seed", "motion", "stops", "duration", "speed", "movable", "rate")
_POSITIVE = ("arena", "sizes", "stops", "duration", "speed", "rate", "rays", "fov", "range_max")
_NOT_NEGATIVE = (
    "range_min",
    "noise",
    "noise_std",
    "gps_noise",
    "compass_noise",
    "odom_noise",
    "seed",
    "at_walls",
    "beam_width",
    "quantum",
    "dropout",
    "outliers",
    "noise_growth",
)

_CONVERTED: Mapping[str, Callable[[Any], Any]] = {
    "kinds": _kinds,
    "per_kind": partial(_counts, "per_kind"),
    "clutter": partial(_counts, "clutter"),
    "room": _room,
    "world": Path,
    "gps_noise": Gps,
    "compass_noise": Compass,
    "odom_noise": lambda noise: OdometryNoise(*noise),
}
"""What a parameter's value becomes in the options of a session."""

_FIELDS = {"world": "world_file", "gps_noise": "gps", "compass_noise": "compass", "odom_noise": "odometry"}
"""The options of a session that parameters of other names become."""
