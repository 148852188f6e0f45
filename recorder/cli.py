"""prim-record: the command line of the recorder."""

from __future__ import annotations

import math
import shlex
import sys
from collections import Counter
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from prim import __version__, console
from prim.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from prim.world import Solid
    from recorder.session import Session, SessionOptions

FOV = 6.28
"""The paper's field of view (rad)."""
FOV_DEGREES = round(math.degrees(FOV), 4)

MM_PER_M = 1000


class MotionName(StrEnum):
    """How the robot moves: put from place to place (``warp``, the paper's word for teleporting), or driving."""

    WARP = "warp"
    DRIVE = "drive"


class DropoutName(StrEnum):
    """What is written for a beam that returned nothing; ``max`` is the longest range."""

    INF = "inf"
    NAN = "nan"
    ZERO = "0"
    MAX = "max"


app = typer.Typer(add_completion=False, rich_markup_mode=None)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"prim-record {__version__}")
        raise typer.Exit


@app.command()
def record(
    context: typer.Context,
    output: Annotated[Path, typer.Argument(metavar="OUT.mcap", help="The log to write.")],
    seed: Annotated[
        int, typer.Option(metavar="N", min=0, help="The same seed and options write the same bytes.")
    ] = 0,
    world: Annotated[Path | None, typer.Option(metavar="WORLD.json", help="Read the world from this file.")] = None,
    arena: Annotated[
        tuple[float, float] | None,
        typer.Option("--arena", "--size", metavar="X Y", help="Size of the floor, metres. [default: 2 2]"),
    ] = None,
    walls: Annotated[
        bool | None, typer.Option("--walls/--no-walls", help="A wall along each edge of the floor. [default: walls]")
    ] = None,
    kinds: Annotated[
        str | None, typer.Option(metavar="KIND,...", help="Kinds of primitives to draw, or all. [default: all]")
    ] = None,
    per_kind: Annotated[
        str | None,
        typer.Option(metavar="N or A-B", help="How many of each kind: a number or a range. [default: 0-2]"),
    ] = None,
    sizes: Annotated[
        tuple[float, float] | None,
        typer.Option(
            metavar="MIN MAX",
            help="Primitives and clutter of these extents, all scales alike. [default: 0.05 to 0.32 m]",
        ),
    ] = None,
    clutter: Annotated[
        str | None,
        typer.Option(metavar="N or A-B", help="How many things that are none of the kinds. [default: 0]"),
    ] = None,
    room: Annotated[
        str | None,
        typer.Option(
            metavar="NAME,...",
            help="box, round, corridor or L; doorways, pilasters, furniture; or some of them. [default: box]",
        ),
    ] = None,
    at_walls: Annotated[
        float | None, typer.Option(metavar="M", help="Every primitive stands this far from a wall; 0: it touches it.")
    ] = None,
    touching: Annotated[
        bool, typer.Option("--touching", help="Primitives stand in pairs that touch each other.")
    ] = False,
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
    range_bias: Annotated[float, typer.Option(metavar="M", help="Added to each range, metres.")] = 0.0,
    beam_width: Annotated[
        float, typer.Option(metavar="DEG", help="Full width of a beam, degrees: mixed ranges at edges.")
    ] = 0.0,
    quantum: Annotated[float, typer.Option(metavar="M", help="Ranges are multiples of this, metres.")] = 0.0,
    dropout: Annotated[float, typer.Option(metavar="SHARE", help="Share of beams that return nothing.")] = 0.0,
    dropout_as: Annotated[
        DropoutName | None, typer.Option(help="What is written for them. [default: inf]", show_default=False)
    ] = None,
    outliers: Annotated[float, typer.Option(metavar="SHARE", help="Share of beams with any range.")] = 0.0,
    noise_growth: Annotated[
        float, typer.Option(metavar="M/M", help="LiDAR noise (std) that grows, metres per metre of range.")
    ] = 0.0,
    gps_noise: Annotated[float, typer.Option(metavar="M", help="GPS noise (std), metres.")] = 0.1,
    compass_noise: Annotated[float, typer.Option(metavar="DEG", help="Compass noise (std), degrees.")] = 3.0,
    force: Annotated[
        bool, typer.Option("--force", help="Replace OUT.mcap even if it is no log of prim-record.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version.")
    ] = False,
) -> int:
    """Record a simulated session of a robot with a 2D LiDAR to an MCAP log."""
    from recorder.keywords import recording_options
    from recorder.session import record_session

    options = recording_options(
        seed=seed,
        world=world,
        arena=arena,
        walls=walls,
        kinds=kinds,
        per_kind=_parse_counts("--per-kind", per_kind),
        sizes=sizes,
        clutter=_parse_counts("--clutter", clutter),
        room=room,
        at_walls=at_walls,
        touching=touching,
        motion=motion.value,
        stops=stops,
        duration=duration,
        speed=speed,
        movable=movable,
        odom_noise=None if odom_noise is None else (odom_noise[0], math.radians(odom_noise[1])),
        rate=rate,
        rays=rays,
        fov=_fov_radians(fov),
        range_min=range_min,
        range_max=range_max,
        noise=noise,
        noise_std=noise_std,
        range_bias=range_bias,
        beam_width=math.radians(beam_width),
        quantum=quantum,
        dropout=dropout,
        dropout_as=None if dropout_as is None else dropout_as.value,
        outliers=outliers,
        noise_growth=noise_growth,
        gps_noise=gps_noise,
        compass_noise=math.radians(compass_noise),
    )
    replaces = output.exists()
    session = record_session(output, options, force, context.obj)
    if not quiet:
        console.echo(_summary(session, options))
        if replaces:
            console.echo("replaced the earlier file of that name")
        console.echo(f"replay it: prim-replay {shlex.quote(str(session.path))}")
    return 0


def _fov_radians(degrees: float) -> float:
    """Convert to radians; the default is the paper's field of view exactly, which degrees only come close to."""
    return FOV if degrees == FOV_DEGREES else math.radians(degrees)


def _parse_counts(option: str, text: str | None) -> tuple[int, int] | None:
    """Parse a number or a range such as 0-2; None stays None. Raises UsageError."""
    if text is None:
        return None
    first, _, last = text.partition("-")
    try:
        return int(first), int(last or first)
    except ValueError:
        raise UsageError(f"{option} {text!r} is neither a number nor a range such as 0-2") from None


def _summary(session: Session, options: SessionOptions) -> str:
    world = session.world
    skipped = f" ({session.skipped} stops skipped: something stands there)" if session.skipped else ""
    counts = Counter(str(primitive.kind) for primitive in world.primitives)
    said = [
        f"{session.path}: {session.scans} scans of {options.lidar.rays} rays{skipped}",
        f"noise {options.lidar.noise_std * MM_PER_M:g} mm",
        *_faults(options),
        ", ".join(f"{count} {kind}{'s' * (count > 1)}" for kind, count in counts.items()) or "no primitives",
        *_others("clutter", world.clutter),
        *_others("structure", world.structure),
    ]
    return ", ".join(said)


def _others(what: str, solids: Sequence[Solid]) -> list[str]:
    """Say what there is beside primitives; an empty list where there is nothing."""
    counts = Counter(solid.name for solid in solids)
    names = ", ".join(name if count == 1 else f"{count} x {name}" for name, count in counts.items())
    return [f"{len(solids)} of {what} ({names})"] if solids else []


def _faults(options: SessionOptions) -> list[str]:
    """Say what faults the scanner has, in the command line's words and units."""
    faults = options.lidar.faults
    said = {
        "range bias": (faults.range_bias, f"{faults.range_bias * MM_PER_M:g} mm"),
        "beam width": (faults.beam_width, f"{math.degrees(faults.beam_width):g} degrees"),
        "quantum": (faults.quantum, f"{faults.quantum * MM_PER_M:g} mm"),
        "dropouts": (faults.dropouts, f"{faults.dropouts:g} as {faults.dropout_as}"),
        "outliers": (faults.outliers, f"{faults.outliers:g}"),
        "noise growth": (faults.noise_growth, f"{faults.noise_growth * MM_PER_M:g} mm/m"),
    }
    return [f"{name} {text}" for name, (value, text) in said.items() if value]


def main() -> None:
    """Run prim-record: the entry point."""
    console.exit_process(console.run(app, "prim-record", sys.argv[1:]))
