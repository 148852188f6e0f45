"""Network files: ONNX with a model card in the metadata, run by ONNX Runtime. Such a file cannot run code."""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from detect.networks.tiles import STYLES
from prim import strict_json
from prim.environment import environment
from prim.errors import PrimError
from prim.shapes import Kind

if TYPE_CHECKING:
    import onnxruntime

SCHEMA = "prim-weights/1"
CARD_KEY = "prim"
"""Key of the model card in the file's metadata."""

STAGES = ("yolo", "cnn")

PICKLE_PREFIXES = (b"\x80", b"PK")
"""First bytes of a pickle, bare or in torch's archive."""

DETECTOR_FILE = "yolo.onnx"
"""Name of YOLO's file in a folder of weights; the parameter networks have any other names."""

KIND_NAMES = tuple(kind.value for kind in Kind)


class WeightsError(PrimError):
    """A weights file that cannot be used; the message says why, and what to do."""


@dataclass(frozen=True)
class ModelCard:
    """Model card of a network: what it is for, and how it was made. The fields are the keys of its JSON.

    Attributes:
        stage: ``yolo`` or ``cnn``.
        mapper: Name of the mapper whose maps it reads.
        kinds: Names of the kinds, in the order of its outputs.
        preset: Of a cnn, the name of its crops and encoding (parameters.PRESETS).
        channels: Of a cnn, how many channels its crops have: 1, or 3 that are the same.
        style: Rendering of cells (tiles.STYLES).
        resolution: Side of the maps' cells (m).
        thresholds: Of a yolo, the smallest score of a detection by kind.
        about: Data, options and metrics of the training.
    """

    stage: str
    mapper: str
    kinds: tuple[str, ...] = KIND_NAMES
    preset: str | None = None
    channels: int = 3
    style: str = "grey"
    resolution: float = 0.01
    thresholds: Mapping[str, float] = field(default_factory=dict)
    about: Mapping[str, Any] = field(default_factory=dict)

    def to_json(self) -> str:
        """Return the JSON text that is stored in the file."""
        return strict_json.dumps({"schema": SCHEMA} | vars(self))

    @classmethod
    def from_json(cls, text: str) -> ModelCard:
        """Parse a model card.

        Raises:
            ValueError: The text is no model card of this schema, or has unknown fields or impossible values.
        """
        value = strict_json.loads(text)
        if not isinstance(value, dict) or value.pop("schema", None) != SCHEMA:
            raise ValueError(f"no {SCHEMA}")
        try:
            card = cls(**value | {"kinds": tuple(value.get("kinds", KIND_NAMES))})
        except TypeError as error:
            raise ValueError(str(error)) from error
        card._check()
        return card

    def _check(self) -> None:
        """Raise ValueError on values that no exported model card has."""
        known = self.stage in STAGES and self.style in STYLES and all(kind in KIND_NAMES for kind in self.kinds)
        if not known or not isinstance(self.mapper, str) or self.channels not in (1, 3):
            raise ValueError("an unknown stage, kind, style, mapper or number of channels")
        if not isinstance(self.resolution, float) or not self.resolution > 0:
            raise ValueError("an impossible resolution")
        scores = self.thresholds.values() if isinstance(self.thresholds, Mapping) else [None]
        if not all(isinstance(score, float) and 0 <= score <= 1 for score in scores):
            raise ValueError("impossible thresholds")


@dataclass(frozen=True)
class Weights:
    """A loaded network.

    Attributes:
        path: Its file.
        card: Its model card.
        session: ONNX Runtime's session.
    """

    path: Path
    card: ModelCard
    session: onnxruntime.InferenceSession


def load_weights(path: Path, stage: str, mapper: str | None = None, threads: int | None = None) -> Weights:
    """Load a network.

    Args:
        path: Its ONNX file.
        stage: The stage it must be for: ``yolo`` or ``cnn``.
        mapper: The mapper whose maps it must read; None: any.
        threads: Threads that run it; None: one for each core.

    Returns:
        The network, ready to run.

    Raises:
        WeightsError: The file is missing, damaged, a pickle, without a model card, or for something else.
    """
    with environment(ORT_DISABLE_TELEMETRY="1"):
        import onnxruntime
    try:
        content = path.read_bytes()
    except OSError as error:
        raise WeightsError(f"{path}: {error.strerror or error}") from error
    if content.startswith(PICKLE_PREFIXES):
        places = " ".join(shlex.quote(str(place)) for place in (path, path.with_suffix(".onnx")))
        export = f"prim-train export {places} --stage {stage}{f' --mapper {mapper}' if mapper else ''}"
        raise WeightsError(f"{path} is a pickle, which can run code: make an ONNX file of it with: {export}")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads or len(os.sched_getaffinity(0))
    # Threads that spin while they wait for work take the cores from whatever else runs.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 4
    try:
        session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime raises undocumented exceptions of many types
        what = f"{path} is no ONNX network, or a damaged one"
        raise WeightsError(f"{what}: make it anew with prim-train export") from error
    try:
        card = ModelCard.from_json(session.get_modelmeta().custom_metadata_map.get(CARD_KEY, "null"))
    except ValueError as error:
        raise WeightsError(f"{path} has no model card ({error}): make it anew with prim-train export") from error
    if card.stage != stage:
        raise WeightsError(f"{path} is a network for {card.stage}, not for {stage}")
    if mapper is not None and card.mapper != mapper:
        raise WeightsError(f"{path} reads the maps of {card.mapper}, not of {mapper}: use --mapper {card.mapper}")
    return Weights(path, card, session)


def load_weight_set(
    path: Path, mapper: str | None = None, threads: int | None = None
) -> tuple[Weights, list[Weights]]:
    """Load a YOLO network and the parameter networks beside it.

    Args:
        path: A folder of weights, or YOLO's file in it.
        mapper: The mapper whose maps the networks must read; None: any.
        threads: Threads that run each network; None: one for each core.

    Returns:
        YOLO, and the parameter networks.

    Raises:
        WeightsError: As :func:`load_weights`; or a kind has no parameter network or several, or the networks were
            trained on images of another style or resolution than YOLO.
    """
    detector = path / DETECTOR_FILE if path.is_dir() else path
    yolo = load_weights(detector, "yolo", mapper, threads)
    others = sorted(other for other in detector.parent.glob("*.onnx") if other.name != detector.name)
    networks = [load_weights(other, "cnn", yolo.card.mapper, threads) for other in others]
    for network in networks:
        if (network.card.style, network.card.resolution) != (yolo.card.style, yolo.card.resolution):
            raise WeightsError(f"{network.path} reads other images than {yolo.path}: they are of different sets")
    kinds = [kind for network in networks for kind in network.card.kinds]
    duplicates = [kind for kind in KIND_NAMES if kinds.count(kind) > 1]
    if duplicates:
        raise WeightsError(f"{detector.parent} holds several networks for: {', '.join(duplicates)}; keep one of each")
    missing = set(yolo.card.kinds).difference(kinds)
    if missing:
        what = ", ".join(sorted(missing))
        raise WeightsError(f"{detector.parent} holds no network that reads the parameters of: {what}")
    return yolo, networks


SHIPPED = Path(__file__).parent / "shipped"
"""The weights that come with prim: one folder for each mapper."""


def shipped_weights(mapper: str) -> Path | None:
    """Return the folder of the weights that come with prim for a mapper's maps; None where there is none."""
    folder = SHIPPED / mapper
    return folder if folder.is_dir() else None
