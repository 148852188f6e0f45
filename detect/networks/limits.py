"""What a network may take: a file from anywhere is checked against these bounds before it is run."""

from __future__ import annotations

from dataclasses import dataclass


class GraphError(ValueError):
    """A network that is damaged, or that is not run; the message says what is wrong with it."""


@dataclass(frozen=True)
class NetworkLimits:
    """Bounds of a network's file, of its graph, and of one run of it. All are set by hand.

    For comparison: the shipped YOLO's batch of eight tiles takes work of 6e9 multiply-adds, and its tensors 0.2 GB in
    all, 19 MB at a time; a YOLOv5s' batch, or its image of 640 x 640 pixels, 17e9, 0.4 GB, 39 MB. Two cores do such
    work in less than a second, and as much as is allowed, of the slowest operators, in about five.
    """

    max_file_bytes: int = 48 << 20
    """Largest file (bytes)."""

    max_card_bytes: int = 1 << 20
    """Largest model card (bytes of its JSON)."""

    max_fields: int = 200_000
    """Largest number of fields in the file, and of numbers that it does not hold as plain arrays."""

    max_nodes: int = 4096
    """Largest number of nodes of the graph."""

    max_rank: int = 8
    """Largest number of a tensor's dimensions."""

    max_elements: int = 16 << 20
    """Largest number of elements of a tensor."""

    max_constant_bytes: int = 128 << 20
    """Largest sum (bytes) of all tensors that depend on constants alone, which are kept."""

    max_activation_bytes: int = 1 << 30
    """Largest sum (bytes) of all other tensors of a run."""

    max_live_bytes: int = 192 << 20
    """Largest sum (bytes) of those of a run that are needed at a time."""

    max_multiply_adds: float = 40e9
    """Largest number of multiply-adds of a run, where other work counts as many as take as long."""

    max_known: int = 4096
    """Tensors of at most this many elements are computed where they depend on sizes and constants alone."""


DEFAULTS = NetworkLimits()
