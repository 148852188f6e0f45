"""Kinds whose inputs other modules make: networks, and the formats beside MCAP."""

from __future__ import annotations

import importlib
import random
from collections.abc import Callable, Iterable
from functools import cache
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import Any

from bench.fuzzing.case import Case
from bench.fuzzing.samples import Samples
from detect.networks.weights import DETECTOR_FILE, SHIPPED

MODULES = {
    "weights": ("bench.fuzzing.networks", "hostile_networks"),
    "formats": ("bench.fuzzing.formats", "hostile_logs"),
}
"""For each kind the module and its function: from a source of randomness to inputs without end, each what it is and
its bytes, or what it is, its file's name and its bytes."""
MOST = 40
"""One of so many inputs of a function is taken."""
MAPPER = "prob"
"""The mapper whose networks are replaced."""


def is_there(kind: str) -> bool:
    """Return whether the module of a kind is installed."""
    return find_spec(MODULES[kind][0]) is not None


def _made(kind: str, rng: random.Random, default_name: str) -> tuple[str, str, bytes]:
    module, name = MODULES[kind]
    make: Callable[[random.Random], Iterable[Any]] = getattr(importlib.import_module(module), name)
    what, *names, data = rng.choice(list(islice(make(rng), MOST)))
    return what, names[0] if names else default_name, data


def hostile_log(rng: random.Random, samples: Samples) -> Case:
    """Return a log of ``hostile_logs``, see :data:`MODULES`; the samples are not used."""
    what, name, data = _made("formats", rng, "log")
    return Case(what, {name: data})


@cache
def _shipped() -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted((SHIPPED / MAPPER).glob("*.onnx"))}


def hostile_network(rng: random.Random, samples: Samples) -> Case:
    """Return an intact log with a network of ``hostile_networks`` beside the others of a set.

    Args:
        rng: The source of randomness.
        samples: The intact logs.

    Returns:
        The case.
    """
    what, name, data = _made("weights", rng, DETECTOR_FILE)
    name = next((file for file in _shipped() if what.startswith(Path(file).stem)), name)
    networks = {f"weights/{file}": content for file, content in ({**_shipped(), name: data}).items()}
    options = ("--no-viewer", "--mapper", MAPPER, "--weights", "weights")
    return Case(
        f"{name}: {what}", {"log.mcap": samples.by_name["mcap"].data, **networks}, "", options, may_refuse=True
    )
