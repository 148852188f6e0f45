"""Network files: outputs equal torch's; files that cannot be used are refused with their reason."""

from __future__ import annotations

import json
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from detect.networks.onnx_file import Network, Node, Port, write_network
from detect.networks.weights import KIND_NAMES, ModelCard, WeightsError, load_weight_set, load_weights
from prim.text import printable


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (pickle.dumps({"a": 1}), "pickle"),
        (b"PK\x03\x04 an archive of torch", "pickle"),
        (b"", "no ONNX network"),
        (b"garbage" * 100, "no ONNX network"),
    ],
)
def test_files_without_a_network_are_refused(tmp_path: Path, content: bytes, said: str) -> None:
    path = tmp_path / "w.onnx"
    path.write_bytes(content)
    with pytest.raises(WeightsError, match=said):
        load_weights(path, "cnn")


def test_a_missing_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    for path in (tmp_path / "none.onnx", tmp_path):
        with pytest.raises(WeightsError, match=str(path)):
            load_weights(path, "yolo")


def test_a_model_card_is_parsed_from_its_json() -> None:
    card = ModelCard("cnn", "prob", ("circle",), "prim", 1, about={"seed": 3})
    assert ModelCard.from_json(card.to_json()) == card
    for text in ("null", "{}", '{"schema": "prim-weights/1"}', '{"schema": "prim-weights/1", "magic": 1}', "[1]"):
        with pytest.raises(ValueError, match=r"."):
            ModelCard.from_json(text)


@pytest.mark.parametrize("preset", ["prim", "paper"])
@pytest.mark.parametrize("kinds", [("circle",), ("triangle",), KIND_NAMES], ids=["circle", "triangle", "all"])
def test_an_exported_network_has_torchs_outputs(tmp_path: Path, preset: str, kinds: tuple[str, ...]) -> None:
    torch = pytest.importorskip("torch", reason="needs the extra [train]")
    pytest.importorskip("onnx", reason="needs the extra [train]")
    from dataclasses import asdict

    from detect.networks.parameters import PRESETS
    from detect.training.export import export_cnn
    from detect.training.model import ParameterNetwork
    from detect.training.train import CnnOptions
    from prim.errors import UsageError
    from prim.shapes import Kind

    torch.manual_seed(1)
    network = ParameterNetwork([Kind(kind) for kind in kinds], PRESETS[preset])
    network.eval()
    state = {
        "options": asdict(CnnOptions(preset)),
        "kinds": list(kinds),
        "mapper": "forward",
        "style": "grey",
        "network": network.state_dict(),
    }
    torch.save(state, tmp_path / "a.pt")
    with pytest.raises(UsageError, match="maps of forward, not of det"):
        export_cnn(tmp_path / "a.pt", "det", tmp_path / "a.onnx")
    export_cnn(tmp_path / "a.pt", "forward", tmp_path / "a.onnx")
    weights = load_weights(tmp_path / "a.onnx", "cnn", "forward")
    assert (weights.card.kinds, weights.card.preset) == (kinds, preset)
    crops = np.random.default_rng(0).random((5, 1, *[PRESETS[preset].pixels] * 2), dtype=np.float32)
    outputs = weights.session.run(None, {"crops": crops})[0]
    with torch.no_grad():
        expected = network(torch.from_numpy(crops)).numpy()
    assert outputs == pytest.approx(expected, abs=2e-3)  # weights are kept in half precision
    assert np.corrcoef(outputs.ravel(), expected.ravel())[0, 1] > 0.999
    whole = 4 * sum(parameter.numel() for parameter in network.parameters())
    assert (tmp_path / "a.onnx").stat().st_size < 0.6 * whole + 20_000
    with pytest.raises(WeightsError, match="for cnn, not for yolo"):
        load_weights(tmp_path / "a.onnx", "yolo")
    with pytest.raises(WeightsError, match="--mapper forward"):
        load_weights(tmp_path / "a.onnx", "cnn", "det")


def write_identity(path: Path, card: ModelCard | str) -> None:
    """Write the identity as a network with a model card, or with any text in its place."""
    ends = [Port(name, np.dtype(np.float32), ("n", "channels", "rows", "cols")) for name in ("a", "b")]
    text = card if isinstance(card, str) else card.to_json()
    path.write_bytes(
        write_network(Network(8, 17, (Node("Identity", ("a",), ("b",), {}),), {}, *ends, {"prim": text}))
    )


YOLO, CNN = ModelCard("yolo", "det"), ModelCard("cnn", "det", preset="prim", channels=1)


def test_a_folder_of_weights_is_loaded(tmp_path: Path) -> None:
    write_identity(tmp_path / "yolo.onnx", YOLO)
    write_identity(tmp_path / "cnn.onnx", CNN)
    for path in (tmp_path, tmp_path / "yolo.onnx"):
        yolo, networks = load_weight_set(path, "det")
        assert yolo.card == YOLO and [network.card for network in networks] == [CNN]


@pytest.mark.parametrize(
    ("others", "said"),
    [
        ([], "no network that reads the parameters of: circle, ellipse, rectangle, square, triangle"),
        ([replace(CNN, kinds=("square", "circle"))], "no network that reads the parameters of: ellipse, rectangle"),
        ([CNN, replace(CNN, kinds=("square",))], "several networks for: square"),
        ([replace(CNN, mapper="prob")], "reads the maps of prob, not of det"),
        ([replace(CNN, style="rounded")], "reads other images"),
        ([replace(CNN, resolution=0.05)], "reads other images"),
        ([YOLO], "a network for yolo, not for cnn"),
    ],
)
def test_folders_of_inconsistent_weights_are_refused(tmp_path: Path, others: list[ModelCard], said: str) -> None:
    write_identity(tmp_path / "yolo.onnx", YOLO)
    for number, card in enumerate(others):
        write_identity(tmp_path / f"cnn.{number}.onnx", card)
    with pytest.raises(WeightsError, match=said):
        load_weight_set(tmp_path, "det")


@pytest.mark.parametrize(
    "change",
    [
        {"stage": "magic"}, {"stage": None}, {"stage": ["yolo"]}, {"stage": {}},
        {"kinds": [["square"]]}, {"kinds": ["hexagon"]}, {"kinds": "square"}, {"kinds": []}, {"kinds": None},
        {"kinds": {"square": 1}}, {"kinds": ["square", "square"]}, {"kinds": [1]},
        {"style": "loud"}, {"style": 1}, {"style": None},
        {"channels": "a"}, {"channels": True}, {"channels": 3.0}, {"channels": 2}, {"channels": 10**40},
        {"resolution": "x"}, {"resolution": 0.0}, {"resolution": 1e-300}, {"resolution": 1e300},
        {"resolution": -0.01},
        {"resolution": True}, {"resolution": float("nan")}, {"resolution": float("inf")}, {"resolution": 10**400},
        {"thresholds": [1]}, {"thresholds": {"square": 7.0}}, {"thresholds": {"square": float("nan")}},
        {"thresholds": {"square": None}}, {"thresholds": {"hexagon": 0.5}}, {"thresholds": None},
        {"mapper": 3}, {"mapper": "magic"}, {"mapper": "\x1b]0;x\x07"}, {"mapper": "a\nb" * 9999},
        {"preset": "prim"}, {"preset": 1}, {"preset": {}},
        {"about": []}, {"about": None}, {"\x1b[31m": 1}, {"magic" * 9999: 1},
    ],
)  # fmt: skip
def test_impossible_model_cards_are_refused(tmp_path: Path, change: dict[str, object]) -> None:
    write_identity(tmp_path / "a.onnx", json.dumps(json.loads(YOLO.to_json()) | change))
    assert_no_card(tmp_path / "a.onnx", "yolo")


@pytest.mark.parametrize("preset", ["magic", None, 1, [], True])
def test_a_parameter_network_without_a_known_preset_is_refused(tmp_path: Path, preset: object) -> None:
    write_identity(tmp_path / "a.onnx", json.dumps(json.loads(CNN.to_json()) | {"preset": preset}))
    assert_no_card(tmp_path / "a.onnx", "cnn")


@pytest.mark.parametrize(
    "text",
    [
        "", "x", "null", "[]", "[" * 100_000, '{"schema": "prim-weights/1", "about": ' + '{"a": ' * 100_000,
        '{"schema": ' + "1" * 5000 + "}", "\x00", '{"schema": "prim-weights/1"}',
    ],
)  # fmt: skip
def test_texts_that_are_no_model_card_are_refused(tmp_path: Path, text: str) -> None:
    write_identity(tmp_path / "a.onnx", text)
    assert_no_card(tmp_path / "a.onnx", "yolo")


def assert_no_card(path: Path, stage: str) -> None:
    """A network is refused for its card, in one line of printable text that is not long."""
    with pytest.raises(WeightsError, match="has no model card") as caught:
        load_weights(path, stage)
    assert str(caught.value) == printable(str(caught.value)) and len(str(caught.value)) < 500


def test_what_a_card_tells_of_its_training_may_be_nested(tmp_path: Path) -> None:
    about: dict[str, object] = {}
    for _ in range(100):
        about = {"a": about, "n": 1e300}
    write_identity(tmp_path / "a.onnx", replace(YOLO, about=about))
    assert load_weights(tmp_path / "a.onnx", "yolo").card.about == about


def test_files_without_a_checkpoint_are_not_exported(tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="needs the extra [train]")
    from detect.training.export import export_cnn, export_yolo
    from prim.errors import UsageError

    path = tmp_path / "a.pt"
    path.write_bytes(pickle.dumps(print))
    with pytest.raises(UsageError, match="no checkpoint"):
        export_cnn(path, "det", tmp_path / "a.onnx")
    with pytest.raises(UsageError, match="--trust"):
        export_yolo(path, "det", tmp_path / "a.onnx", trust=False)


def test_training_of_an_exported_network_can_be_continued(tmp_path: Path) -> None:
    """Imported, with unfolded normalisations, it has the same outputs; nothing in the file is executed."""
    torch = pytest.importorskip("torch", reason="needs the extra [train]")
    pytest.importorskip("ultralytics", reason="needs the extra [train]")
    from detect.networks.parameters import PRIM
    from detect.networks.weights import SHIPPED
    from detect.training.export import import_cnn, import_yolo
    from detect.training.model import ParameterNetwork
    from prim.errors import UsageError
    from prim.shapes import Kind

    torch.manual_seed(0)
    yolo, (cnn,) = load_weight_set(SHIPPED / "forward")
    images = torch.rand(4, 3, 96, 96)
    opened = torch.load(import_yolo(yolo.path, images, tmp_path / "a.pt"), weights_only=False)["model"].float()
    with torch.no_grad():
        again = opened.eval()(images)[0].numpy()
    before = yolo.session.run(None, {"images": images.numpy()})[0]
    assert again == pytest.approx(before, abs=2e-3)
    trained = opened.train()(images)  # the statistics of the normalisations are those of their inputs
    assert all(torch.isfinite(part).all() for part in trained.values() if isinstance(part, torch.Tensor))

    network, crops = ParameterNetwork(list(Kind), PRIM), torch.rand(4, 1, 72, 72)
    import_cnn(cnn.path, network, crops)
    with torch.no_grad():
        outputs = network.eval()(crops).numpy()
    assert outputs == pytest.approx(cnn.session.run(None, {"crops": crops.numpy()})[0], abs=1e-4)

    with pytest.raises(UsageError, match="no YOLOv5n"):
        import_yolo(cnn.path, images, tmp_path / "b.pt")
    with pytest.raises(UsageError, match="no network of this preset"):
        import_cnn(yolo.path, network, crops)
    (tmp_path / "junk.onnx").write_bytes(b"junk")
    with pytest.raises(UsageError, match="no ONNX network"):
        import_cnn(tmp_path / "junk.onnx", network, crops)
