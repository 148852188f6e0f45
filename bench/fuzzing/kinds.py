"""The table of kinds of damage: what the fuzzer does, and how often."""

from __future__ import annotations

import random
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from bench.fuzzing.bombs import bomb
from bench.fuzzing.case import Case, Generator
from bench.fuzzing.channels import hostile_channels
from bench.fuzzing.damage import damaged_bytes
from bench.fuzzing.documents import hostile_json
from bench.fuzzing.foxglove_messages import wild_foxglove_messages
from bench.fuzzing.messages import wild_ros_messages, wild_scans
from bench.fuzzing.others import MODULES, hostile_log, hostile_network, is_there
from bench.fuzzing.records import damaged_records
from bench.fuzzing.samples import Samples
from bench.fuzzing.summaries import lying_summary


class Kind(NamedTuple):
    """A kind of damage.

    Attributes:
        name: Its name.
        share: How many of all cases are of it, beside the shares of the others.
        generate: Makes a case.
        lists: Whether each log is listed, too.
    """

    name: str
    share: float
    generate: Generator
    lists: bool = False


KINDS: Mapping[str, Kind] = {
    kind.name: kind
    for kind in (
        Kind("bytes", 30, damaged_bytes),
        Kind("records", 14, damaged_records),
        Kind("summaries", 20, lying_summary, lists=True),
        Kind("messages", 10, wild_ros_messages, lists=True),
        Kind("foxglove", 4, wild_foxglove_messages),
        Kind("scans", 2, wild_scans),
        Kind("channels", 6, hostile_channels, lists=True),
        Kind("json", 8, hostile_json),
        Kind("bombs", 4, bomb, lists=True),
        Kind("formats", 10, hostile_log),
        Kind("weights", 3, hostile_network),
    )
    if kind.name not in MODULES or is_there(kind.name)
}
"""All kinds by their names; those whose module is not there are left out."""


def make_case(kind: str, number: int, seed: int, samples: Samples) -> Case:
    """Make one case: the same one whenever it is asked for.

    Args:
        kind: The name of its kind.
        number: Which one of that kind.
        seed: Of the whole run.
        samples: The intact logs.

    Returns:
        The case.
    """
    return KINDS[kind].generate(random.Random(f"{seed}:{kind}:{number}"), samples)


def plan(kinds: Iterable[str], cases: int) -> list[tuple[str, int]]:
    """Return which cases make up a run: of each kind its share and at least one, spread evenly over the run.

    Args:
        kinds: The names of the kinds.
        cases: How many cases in all, about.

    Returns:
        Names of kinds, and numbers.
    """
    names = list(kinds)
    total = sum(KINDS[name].share for name in names)
    counts = {name: max(1, round(cases * KINDS[name].share / total)) for name in names}
    places = [((number + 0.5) / count, name, number) for name, count in counts.items() for number in range(count)]
    return [(name, number) for _, name, number in sorted(places)]
