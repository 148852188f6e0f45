"""prim-record: the command line of the recorder."""

from __future__ import annotations

import math
import sys
from collections import Counter
from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from prim import __version__, console
from prim.errors import UsageError

if TYPE_CHECKING:
    from prim.shapes import Kind
    from recorder.odometry import OdometryNoise
    from recorder.session import Session, SessionOptions

PAPER_NOISE_UNIT = 5.0
"""``--noise 1`` is a standard deviation of this many metres (the paper's IV-A)."""

ALL_KINDS = "all"
SIZE = (2.0, 2.0)
PER_KIND = "0-2"
"""What is drawn by default."""

FOV = 6.28
"""The paper's field of view (rad)."""
FOV_DEGREES = round(math.degrees(FOV), 4)

MIN_RATE, MAX_RATE = 1e-3, 1e6
"""Scans per second; beyond, stamps in whole ns run into each other or out of their range."""
MAX_LENGTH = 1e6
"""Floors and ranges (m) are no larger: float32 ranges would be off by more than centimetres."""
FULL_TURN = 360.0

MM_PER_M = 1000


class MotionName(StrEnum):
    """How the robot moves: put from place to place (``warp``, the paper's word for teleporting), or driving."""

    WARP = "warp"
    DRIVE = "drive"


app = typer.Typer(add_completion=False, rich_markup_mode=None)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"prim-record {__version__}")
        raise typer.Exit


@app.command()
def record(
    output: Annotated[Path, typer.Argument(metavar="OUT.mcap", help="The log to write.")],
    seed: Annotated[
        int, typer.Option(metavar="N", min=0, help="The same seed and options write the same bytes.")
    ] = 0,
    world: Annotated[Path | None, typer.Option(metavar="WORLD.json", help="Read the world from this file.")] = None,
    size: Annotated[tuple[float, float], typer.Option(metavar="X Y", help="Size of the floor, metres.")] = SIZE,
    walls: Annotated[bool, typer.Option(help="A wall along each edge of the floor.")] = True,
    kinds: Annotated[str, typer.Option(metavar="KIND,...", help="Kinds of primitives to draw, or all.")] = ALL_KINDS,
    per_kind: Annotated[
        str, typer.Option(metavar="N or A-B", help="How many of each kind: a number or a range.")
    ] = PER_KIND,
    motion: Annotated[
        MotionName, typer.Option(help="The robot is set on a grid of positions, or drives.")
    ] = MotionName.WARP,
    stops: Annotated[
        tuple[int, int] | None,
        typer.Option(metavar="COLS ROWS", help="The grid of positions of --motion warp. [default: 10 10]"),
    ] = None,
    duration: Annotated[
        float | None, typer.Option(metavar="S", help="How long it drives, seconds. [default: 60]")
    ] = None,
    speed: Annotated[
        float | None, typer.Option(metavar="M/S", help="How fast it drives, metres per second. [default: 0.2]")
    ] = None,
    movable: Annotated[bool, typer.Option("--movable", help="A driving robot can push the primitives.")] = False,
    odom_noise: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="M DEG", help="Noise (std) of odometry after one metre. [default: 0.05 2]"),
    ] = None,
    rate: Annotated[float, typer.Option(metavar="HZ", help="Scans per second.")] = 10.0,
    rays: Annotated[int, typer.Option(metavar="N", min=1, help="Beams in a scan.")] = 500,
    fov: Annotated[float, typer.Option(metavar="DEG", help="Field of view, degrees.")] = FOV_DEGREES,
    range_min: Annotated[float, typer.Option(metavar="M", help="Shortest range, metres.")] = 0.032,
    range_max: Annotated[float, typer.Option(metavar="M", help="Longest range, metres.")] = 5.0,
    noise: Annotated[
        float | None, typer.Option(metavar="F", help="LiDAR noise (std) as a share of 5 m, the paper's unit.")
    ] = None,
    noise_std: Annotated[
        float | None,
        typer.Option(
            metavar="M", help="LiDAR noise (std), metres; excludes --noise. [default: 0.05]", show_default=False
        ),
    ] = None,
    gps_noise: Annotated[float, typer.Option(metavar="M", help="GPS noise (std), metres.")] = 0.1,
    compass_noise: Annotated[float, typer.Option(metavar="DEG", help="Compass noise (std), degrees.")] = 3.0,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version.")
    ] = False,
) -> int:
    """Record a simulated session of a robot with a 2D LiDAR to an MCAP log."""
    from recorder.sensors import Compass, Gps, Lidar
    from recorder.session import SessionOptions, record_session
    from recorder.world import WorldOptions

    _check_world(world, is_drawn=(size, walls, kinds, per_kind) != (SIZE, True, ALL_KINDS, PER_KIND))
    _check_scans(size, rate, fov, range_min, range_max)
    _check_positive({"--stops": min(stops) if stops else None})
    _check_not_negative({"--gps-noise": gps_noise, "--compass-noise": compass_noise})
    drive_options = {
        "--duration": duration,
        "--speed": speed,
        "--movable": movable or None,
        "--odom-noise": odom_noise,
    }
    _check_motion(motion, drive_options, {"--stops": stops})
    _check_positive({"--duration": duration, "--speed": speed})
    defaults = SessionOptions()
    options = SessionOptions(
        seed=seed,
        world=WorldOptions(size, _kinds(kinds), _per_kind(per_kind), walls),
        world_file=world,
        motion=motion.value,
        stops=stops or defaults.stops,
        duration=duration or defaults.duration,
        speed=speed or defaults.speed,
        movable=movable,
        rate=rate,
        lidar=Lidar(rays, _fov_radians(fov), range_min, range_max, _noise_std(noise, noise_std)),
        gps=Gps(gps_noise),
        compass=Compass(math.radians(compass_noise)),
        odometry=_odometry_noise(odom_noise),
    )
    session = record_session(output, options)
    if not quiet:
        typer.echo(_summary(session, options))
    return 0


def _fov_radians(degrees: float) -> float:
    """Convert to radians; the default is the paper's field of view exactly, which degrees only come close to."""
    return FOV if degrees == FOV_DEGREES else math.radians(degrees)


def _kinds(text: str) -> tuple[Kind, ...]:
    from prim.shapes import Kind

    names = [*Kind] if text == ALL_KINDS else [name.strip() for name in text.split(",") if name.strip()]
    unknown = [name for name in names if name not in [*Kind]]
    if unknown or not names:
        what = f"{', '.join(unknown)} is no kind" if unknown else "it names no kind"
        raise UsageError(f"--kinds {text}: {what}; the kinds are {','.join(Kind)}")
    return tuple(Kind(name) for name in names)


def _per_kind(text: str) -> tuple[int, int]:
    first, _, last = text.partition("-")
    try:
        fewest, most = int(first), int(last or first)
    except ValueError:
        raise UsageError(f"--per-kind {text!r} is neither a number nor a range such as 0-2") from None
    if not 0 <= fewest <= most:
        raise UsageError(f"--per-kind {text!r} is not a range from small to large")
    return fewest, most


def _noise_std(noise: float | None, noise_std: float | None) -> float:
    """Return the LiDAR's noise (m), given in either unit or by default."""
    from recorder.sensors import Lidar

    if noise is not None and noise_std is not None:
        raise UsageError("--noise and --noise-std say the same in two units: give one of them")
    _check_not_negative({"--noise": noise, "--noise-std": noise_std})
    if noise is not None:
        return noise * PAPER_NOISE_UNIT
    return Lidar.noise_std if noise_std is None else noise_std


def _odometry_noise(odom_noise: tuple[float, float] | None) -> OdometryNoise:
    """Return the odometry's noise, given in metres and degrees or by default."""
    from recorder.odometry import OdometryNoise

    if odom_noise is None:
        return OdometryNoise()
    _check_not_negative({"--odom-noise": min(odom_noise)})
    return OdometryNoise(odom_noise[0], math.radians(odom_noise[1]))


def _check_world(world: Path | None, is_drawn: bool) -> None:
    """Raise UsageError where a world is both read and drawn."""
    if world is not None and is_drawn:
        raise UsageError("--world excludes --size, --no-walls, --kinds and --per-kind: the file says it all")


def _check_scans(size: tuple[float, float], rate: float, fov: float, range_min: float, range_max: float) -> None:
    """Raise UsageError for a floor or a scanner that cannot be."""
    _check_positive({"--size": min(size), "--rate": rate, "--fov": fov, "--range-max": range_max})
    _check_not_negative({"--range-min": range_min})
    if range_min >= range_max:
        raise UsageError(f"--range-min {range_min:g} is not below --range-max {range_max:g}")
    if not MIN_RATE <= rate <= MAX_RATE:
        raise UsageError(f"--rate is {rate:g}: it must be from {MIN_RATE:g} to {MAX_RATE:.0f} scans per second")
    if max(range_max, *size) > MAX_LENGTH:
        raise UsageError(f"--range-max and --size must not be above {MAX_LENGTH:.0f} m")
    if fov > FULL_TURN:
        raise UsageError(f"--fov {fov:g} is more than a full turn of {FULL_TURN:g} degrees")


def _check_motion(motion: MotionName, drives: Mapping[str, object], warps: Mapping[str, object]) -> None:
    """Raise UsageError for an option that goes with the other motion."""
    other = warps if motion is MotionName.DRIVE else drives
    given = [name for name, value in other.items() if value is not None]
    if given:
        raise UsageError(f"{given[0]} does not go with --motion {motion.value}")


def _check_positive(values: Mapping[str, float | None]) -> None:
    for name, value in values.items():
        if value is not None and not (value > 0 and math.isfinite(value)):
            raise UsageError(f"{name} is {value:g}: it must be above 0")


def _check_not_negative(values: Mapping[str, float | None]) -> None:
    for name, value in values.items():
        if value is not None and not (value >= 0 and math.isfinite(value)):
            raise UsageError(f"{name} is {value:g}: it must not be below 0")


def _summary(session: Session, options: SessionOptions) -> str:
    counts = Counter(str(primitive.kind) for primitive in session.world.primitives)
    what = ", ".join(f"{count} {kind}{'s' * (count > 1)}" for kind, count in counts.items()) or "no primitives"
    skipped = f" ({session.skipped} stops skipped: something stands there)" if session.skipped else ""
    return (
        f"{session.path}: {session.scans} scans of {options.lidar.rays} rays{skipped}, "
        f"noise {options.lidar.noise_std * MM_PER_M:g} mm, {what}\nreplay it: prim-replay {session.path}"
    )


def main() -> None:
    """Run prim-record: the entry point."""
    sys.exit(console.run(app, "prim-record", sys.argv[1:]))
