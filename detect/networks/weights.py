"""Networks as files: ONNX with a model card, run by ONNX Runtime. No such file can run code."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from detect.networks.tiles import STYLES
from prim.errors import PrimError
from prim.shapes import Kind

if TYPE_CHECKING:
    pass

if TYPE_CHECKING:
    import onnxruntime

SCHEMA = "prim-weights/1"
CARD_KEY = "prim"
"""The card's key in the file's metadata."""

STAGES = ("yolo", "cnn")

PICKLES = (b"\x80", b"PK")
"""How a pickle begins, bare or in torch's archive."""

DETECTOR = "yolo.onnx"
"""A folder of weights holds YOLO under this name, and the networks that read parameters under any other."""

ALL_KINDS = tuple(kind.value for kind in Kind)


class WeightsError(PrimError):
    """A weights file that cannot be used: what is wrong with it, and what to do."""


@dataclass(frozen=True)
class Card:
    """What a network is for, and what is known of its making.

    ``stage``: yolo or cnn; ``mapper``: whose maps it reads; ``kinds``: in the order of its outputs; ``preset``: how a
    cnn's crops are made (networks.parameters); ``style``: how cells are shown (tiles.STYLES); ``resolution``: of
    the maps (m); ``thresholds``: of a yolo, the least score per kind; ``about``: data, options, metrics.
    """

    stage: str
    mapper: str
    kinds: tuple[str, ...] = ALL_KINDS
    preset: str | None = None
    channels: int = 3
    style: str = "grey"
    resolution: float = 0.01
    thresholds: Mapping[str, float] = field(default_factory=dict)
    about: Mapping[str, Any] = field(default_factory=dict)

    def to_json(self) -> str:
        """As it stands in the file."""
        return json.dumps({"schema": SCHEMA} | vars(self))

    @classmethod
    def from_json(cls, text: str) -> Card:
        """Reads a card. Raises ValueError on one that is none."""
        value = json.loads(text)
        if not isinstance(value, dict) or value.pop("schema", None) != SCHEMA:
            raise ValueError(f"no {SCHEMA}")
        try:
            card = cls(**value | {"kinds": tuple(value.get("kinds", ALL_KINDS))})
        except TypeError as error:
            raise ValueError(str(error)) from error
        card._check()
        return card

    def _check(self) -> None:
        """Raises ValueError on what no card of ours says."""
        known = self.stage in STAGES and self.style in STYLES and all(kind in ALL_KINDS for kind in self.kinds)
        if not known or not isinstance(self.mapper, str) or self.channels not in (1, 3):
            raise ValueError("an unknown stage, kind, style, mapper or number of channels")
        if not isinstance(self.resolution, float) or not self.resolution > 0:
            raise ValueError("a resolution that is none")
        scores = self.thresholds.values() if isinstance(self.thresholds, Mapping) else [None]
        if not all(isinstance(score, float) and 0 <= score <= 1 for score in scores):
            raise ValueError("thresholds that are none")


@dataclass(frozen=True)
class Weights:
    """A network that is ready to run, and its card."""

    path: Path
    card: Card
    session: onnxruntime.InferenceSession


def load_weights(path: Path, stage: str, mapper: str | None = None, threads: int | None = None) -> Weights:
    """Opens a network of a ``stage``, for the maps of ``mapper`` where one is named; runs on all cores by default.

    Raises WeightsError on a file that is missing, corrupt, a pickle, without a card, or for something else.
    """
    import onnxruntime

    try:
        content = path.read_bytes()
    except OSError as error:
        raise WeightsError(f"{path}: {error.strerror or error}") from error
    if content.startswith(PICKLES):
        raise WeightsError(f"{path} is a pickle, which can run code: make an ONNX file of it with prim-train export")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads or len(os.sched_getaffinity(0))
    # Threads that wait for a network in a loop take the cores from what runs beside it.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 4
    try:
        session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime raises many kinds, none of them documented
        what = f"{path} is no ONNX network, or a damaged one"
        raise WeightsError(f"{what}: make it anew with prim-train export") from error
    try:
        card = Card.from_json(session.get_modelmeta().custom_metadata_map.get(CARD_KEY, "null"))
    except ValueError as error:
        raise WeightsError(f"{path} has no model card ({error}): make it anew with prim-train export") from error
    if card.stage != stage:
        raise WeightsError(f"{path} is a network for {card.stage}, not for {stage}")
    if mapper is not None and card.mapper != mapper:
        raise WeightsError(f"{path} reads the maps of {card.mapper}, not of {mapper}: use --mapper {card.mapper}")
    return Weights(path, card, session)


def load_set(path: Path, mapper: str | None = None, threads: int | None = None) -> tuple[Weights, list[Weights]]:
    """Opens a YOLO and the networks that read parameters beside it: a folder, or the YOLO's own file in it.

    Raises WeightsError as :func:`load_weights`, and where a kind's network is missing, there twice, or does not go
    with the YOLO.
    """
    detector = path / DETECTOR if path.is_dir() else path
    yolo = load_weights(detector, "yolo", mapper, threads)
    others = sorted(other for other in detector.parent.glob("*.onnx") if other.name != detector.name)
    networks = [load_weights(other, "cnn", yolo.card.mapper, threads) for other in others]
    for network in networks:
        if (network.card.style, network.card.resolution) != (yolo.card.style, yolo.card.resolution):
            raise WeightsError(f"{network.path} reads other images than {yolo.path}: they are of different sets")
    kinds = [kind for network in networks for kind in network.card.kinds]
    twice = [kind for kind in ALL_KINDS if kinds.count(kind) > 1]
    if twice:
        raise WeightsError(f"{detector.parent} holds several networks for: {', '.join(twice)}; keep one of each")
    missing = set(yolo.card.kinds).difference(kinds)
    if missing:
        what = ", ".join(sorted(missing))
        raise WeightsError(f"{detector.parent} holds no network that reads the parameters of: {what}")
    return yolo, networks


SHIPPED = Path(__file__).parent / "shipped"
"""The weights that come with prim: a folder for each mapper."""


def shipped_weights(mapper: str) -> Path | None:
    """The weights for a mapper's maps that come with prim; None where none do."""
    folder = SHIPPED / mapper
    return folder if folder.is_dir() else None
