"""Network files: ONNX with a model card in the metadata, run by ONNX Runtime.

Such a file cannot run code. What it would compute is checked before ONNX Runtime sees it: see onnx_check.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from detect.networks.limits import DEFAULTS, GraphError, NetworkLimits
from detect.networks.onnx_check import NetworkCheck
from detect.networks.onnx_file import read_network, write_network
from detect.networks.tiles import STYLES, TILE_SIZE
from mapping.mapper import MAX_RESOLUTION, MIN_RESOLUTION
from prim import strict_json
from prim.choices import MapperName
from prim.environment import environment
from prim.errors import PrimError
from prim.shapes import Kind
from prim.text import printable

if TYPE_CHECKING:
    import onnxruntime

    from detect.networks.parameters import Preset

SCHEMA = "prim-weights/1"
CARD_KEY = "prim"
"""Key of the model card in the file's metadata."""

STAGES = ("yolo", "cnn")

PICKLE_PREFIXES = (b"\x80", b"PK")
"""First bytes of a pickle, bare or in torch's archive."""

DETECTOR_FILE = "yolo.onnx"
"""Name of YOLO's file in a folder of weights; the parameter networks have any other names."""

KIND_NAMES = tuple(kind.value for kind in Kind)

CHANNELS = 3
"""Channels of a tile's image."""

BATCHES = {"yolo": 8, "cnn": 32}
"""The most images of each stage that a network is run on at a time: it bounds memory; set by hand."""

ANOTHER = "use a network that prim-train export made"
AGAIN = "make it anew with prim-train export"


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
        unknown = value.keys() - {field.name for field in fields(cls)}
        if unknown:
            raise ValueError(f"an unknown field {strict_json.shown(min(unknown))}")
        kinds = value.get("kinds", list(KIND_NAMES))
        if (
            not isinstance(kinds, list)
            or not kinds
            or not all(kinds.count(k) == 1 and k in KIND_NAMES for k in kinds)
        ):
            raise ValueError("impossible kinds")
        try:
            card = cls(**value | {"kinds": tuple(kinds)})
        except TypeError as error:
            raise ValueError(str(error)) from error
        card._check()
        return card

    def _check(self) -> None:
        """Raise ValueError on values that no exported model card has."""
        texts = (self.stage, STAGES), (self.style, STYLES), (self.mapper, [*MapperName]), (self.preset, self._presets)
        for text, known in texts:
            if text not in known:
                raise ValueError(f"an unknown stage, style, mapper or preset: {strict_json.shown(text)}")
        if type(self.channels) is not int or self.channels not in (1, CHANNELS):
            raise ValueError(f"an impossible number of channels: {strict_json.shown(self.channels)}")
        if not isinstance(self.resolution, float) or not MIN_RESOLUTION <= self.resolution <= MAX_RESOLUTION:
            raise ValueError(f"an impossible resolution: {strict_json.shown(self.resolution)}")
        if not isinstance(self.thresholds, dict) or not self.thresholds.keys() <= set(KIND_NAMES):
            raise ValueError("impossible thresholds")
        if not all(isinstance(score, float) and 0 <= score <= 1 for score in self.thresholds.values()):
            raise ValueError("impossible thresholds")
        if not isinstance(self.about, dict):
            raise ValueError("an impossible entry about its training")

    @property
    def _presets(self) -> list[str | None]:
        """The presets that it may name."""
        return [*_presets()] if self.stage == "cnn" else [None]

    def input_shape(self, batch: int) -> tuple[int, ...]:
        """Return the shape (batch, channels, rows, cols) of the images that the network is run on."""
        if self.stage == "cnn":
            pixels = _presets()[str(self.preset)].pixels
            return batch, self.channels, pixels, pixels
        return batch, CHANNELS, TILE_SIZE, TILE_SIZE


def _presets() -> Mapping[str, Preset]:
    from detect.networks.parameters import PRESETS  # when they are needed: OpenCV takes time to load

    return PRESETS


@dataclass(frozen=True)
class Weights:
    """A loaded network.

    Attributes:
        path: Its file.
        card: Its model card.
        session: ONNX Runtime's session.
        check: Checks what a run takes; None where the network is not one from a file.
    """

    path: Path
    card: ModelCard
    session: onnxruntime.InferenceSession
    check: NetworkCheck | None = None

    def run(self, images: NDArray[np.float32]) -> NDArray[np.float32]:
        """Run the network.

        Args:
            images: (N, channels, rows, cols), 0 to 1; at most BATCHES of them.

        Returns:
            Its first output, of finite numbers.

        Raises:
            WeightsError: The network does not take such images, takes too much for them, or gives outputs that are
                not finite.
        """
        try:
            if self.check is not None:
                self.check(images.shape)
            found = self.session.run(None, {self.session.get_inputs()[0].name: images})[0]
            outputs = np.asarray(found, dtype=np.float32)
        except GraphError as error:
            raise WeightsError(f"{self.path} cannot be used: {error}; {ANOTHER}") from error
        except Exception as error:  # ONNX Runtime raises undocumented exceptions of many types
            shape = " x ".join(map(str, images.shape))
            raise WeightsError(f"{self.path} does not take images of {shape}, as its card says: {AGAIN}") from error
        if not np.isfinite(outputs).all():
            raise WeightsError(f"{self.path} gives outputs that are not finite: {AGAIN}")
        return outputs


def load_weights(
    path: Path,
    stage: str,
    mapper: str | None = None,
    threads: int | None = None,
    limits: NetworkLimits = DEFAULTS,
) -> Weights:
    """Load a network.

    Args:
        path: Its ONNX file.
        stage: The stage it must be for: ``yolo`` or ``cnn``.
        mapper: The mapper whose maps it must read; None: any.
        threads: Threads that run it; None: one for each core.
        limits: What it may take.

    Returns:
        The network, ready to run.

    Raises:
        WeightsError: The file is missing, damaged, a pickle, without a model card, or for something else; or it has
            operators that are not run, or would take too much.
    """
    content = _read(path, stage, mapper, limits)
    try:
        network = read_network(content, limits)
    except GraphError as error:
        raise WeightsError(f"{path} cannot be used: {error}; {ANOTHER}") from error
    card = _card(path, network.metadata.get(CARD_KEY, "null"), limits)
    if card.stage != stage:
        raise WeightsError(f"{path} is a network for {card.stage}, not for {stage}")
    if mapper is not None and card.mapper != mapper:
        raise WeightsError(f"{path} reads the maps of {card.mapper}, not of {mapper}: use --mapper {card.mapper}")
    check = NetworkCheck(network, limits)
    try:
        for batch in (1, BATCHES[stage]):
            check(card.input_shape(batch))
        return Weights(path, card, _session(write_network(replace(network, metadata={})), threads), check)
    except GraphError as error:
        raise WeightsError(f"{path} cannot be used: {error}; {ANOTHER}") from error
    except Exception as error:  # ONNX Runtime raises undocumented exceptions of many types
        raise WeightsError(f"{path} is no ONNX network, or a damaged one: {AGAIN}") from error


def _read(path: Path, stage: str, mapper: str | None, limits: NetworkLimits) -> bytes:
    """Return a file's content, but no more than may be used."""
    try:
        with path.open("rb") as file:
            content = file.read(limits.max_file_bytes + 1)
    except OSError as error:
        raise WeightsError(f"{path}: {error.strerror or error}") from error
    if content.startswith(PICKLE_PREFIXES):
        places = " ".join(shlex.quote(str(place)) for place in (path, path.with_suffix(".onnx")))
        export = f"prim-train export {places} --stage {stage}{f' --mapper {mapper}' if mapper else ''}"
        raise WeightsError(f"{path} is a pickle, which can run code: make an ONNX file of it with: {export}")
    return content


def _card(path: Path, text: str, limits: NetworkLimits) -> ModelCard:
    try:
        if len(text) > limits.max_card_bytes:
            raise ValueError(f"more than {limits.max_card_bytes} characters")
        return ModelCard.from_json(text)
    except ValueError as error:
        raise WeightsError(f"{path} has no model card ({printable(str(error))}): {AGAIN}") from error


def _session(content: bytes, threads: int | None) -> onnxruntime.InferenceSession:
    with environment(ORT_DISABLE_TELEMETRY="1"):
        import onnxruntime
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads or len(os.sched_getaffinity(0))
    # Threads that spin while they wait for work take the cores from whatever else runs.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 4
    return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])


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
