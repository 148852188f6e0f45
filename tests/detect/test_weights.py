"""Networks as files: the same numbers as torch's, and clear errors for files that cannot be used."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

from detect.weights import Card, WeightsError, load_weights


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (pickle.dumps({"a": 1}), "pickle"),
        (b"PK\x03\x04 an archive of torch", "pickle"),
        (b"", "no ONNX network"),
        (b"garbage" * 100, "no ONNX network"),
    ],
)
def test_files_that_are_no_networks(tmp_path: Path, content: bytes, said: str) -> None:
    path = tmp_path / "w.onnx"
    path.write_bytes(content)
    with pytest.raises(WeightsError, match=said):
        load_weights(path, "cnn")


def test_a_missing_file_and_a_folder(tmp_path: Path) -> None:
    for path in (tmp_path / "none.onnx", tmp_path):
        with pytest.raises(WeightsError, match=str(path)):
            load_weights(path, "yolo")


def test_a_card_reads_back() -> None:
    card = Card("cnn", "prob", ("circle",), "prim", 1, about={"seed": 3})
    assert Card.from_json(card.to_json()) == card
    for text in ("null", "{}", '{"schema": "prim-weights/1"}', '{"schema": "prim-weights/1", "magic": 1}', "[1]"):
        with pytest.raises(ValueError, match=r"."):
            Card.from_json(text)


@pytest.mark.parametrize("preset", ["prim", "paper"])
@pytest.mark.parametrize("kind", ["circle", "triangle"])
def test_an_exported_network_gives_torch_s_numbers(tmp_path: Path, preset: str, kind: str) -> None:
    torch = pytest.importorskip("torch", reason="needs the extra [train]")
    pytest.importorskip("onnx", reason="needs the extra [train]")
    from dataclasses import asdict

    from detect.export import export_cnn
    from detect.networks import ParameterNetwork
    from detect.parameters import PRESETS
    from detect.train import CnnOptions
    from prim.shapes import Kind

    torch.manual_seed(1)
    network = ParameterNetwork([Kind(kind)], PRESETS[preset])
    network.eval()
    state = {"options": asdict(CnnOptions(preset)), "kinds": [kind], "network": network.state_dict()}
    torch.save(state, tmp_path / "a.pt")
    export_cnn(tmp_path / "a.pt", "forward", tmp_path / "a.onnx")
    weights = load_weights(tmp_path / "a.onnx", "cnn", "forward")
    assert (weights.card.kinds, weights.card.preset) == ((kind,), preset)
    crops = np.random.default_rng(0).random((5, 1, *[PRESETS[preset].pixels] * 2), dtype=np.float32)
    outputs = weights.session.run(None, {"crops": crops})[0]
    with torch.no_grad():
        wanted = network(torch.from_numpy(crops)).numpy()
    assert outputs == pytest.approx(wanted, abs=2e-3)  # weights are kept in half precision
    assert np.corrcoef(outputs.ravel(), wanted.ravel())[0, 1] > 0.999
    whole = 4 * sum(parameter.numel() for parameter in network.parameters())
    assert (tmp_path / "a.onnx").stat().st_size < 0.6 * whole + 20_000
    with pytest.raises(WeightsError, match="for cnn, not for yolo"):
        load_weights(tmp_path / "a.onnx", "yolo")
    with pytest.raises(WeightsError, match="--mapper forward"):
        load_weights(tmp_path / "a.onnx", "cnn", "det")


def test_what_is_no_checkpoint_is_not_exported(tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="needs the extra [train]")
    from detect.export import export_cnn, export_yolo
    from prim.errors import UsageError

    path = tmp_path / "a.pt"
    path.write_bytes(pickle.dumps(print))
    with pytest.raises(UsageError, match="no checkpoint"):
        export_cnn(path, "det", tmp_path / "a.onnx")
    with pytest.raises(UsageError, match="--trust"):
        export_yolo(path, "det", tmp_path / "a.onnx", trust=False)
