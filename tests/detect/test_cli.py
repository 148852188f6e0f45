"""The command line of prim-train."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from detect import cli
from detect.networks.tiles import TILE_SIZE
from detect.networks.weights import SHIPPED, load_weights
from prim import console
from prim.choices import MapperName

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(in_tmp: Path, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run prim-train in a folder of its own; exit code, stdout, stderr."""

    def call(*arguments: object) -> tuple[int, str, str]:
        code = console.run(cli.train, "prim-train", [str(argument) for argument in arguments])
        seen = capsys.readouterr()
        return code, seen.out, seen.err

    return call


def test_a_data_set_is_made_and_continued(run: Run) -> None:
    options = ("--maps", 1, 1, "--noise-std", 0.1, "--mapper", "det", "--kind", "circle", "--seed", 5)
    code, out, err = run("dataset", "set", *options)
    assert (code, err) == (0, "") and out.startswith("made 2 of 2 sessions in set")
    assert run("dataset", "set", *options)[1].startswith("made 0 of 2")
    code, _, err = run("dataset", "set", *options[:-1], 6)
    assert code == 2 and "other options" in err and err.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["dataset", "a", "--maps", "0", "0"], "at least one session"),
        (["dataset", "a", "--mapper", "magic"], "--mapper"),
        (["dataset", "a", "--kind", "magic"], "choose from all, square"),
        (["dataset", "a", "--noise-std", "nan"], "--noise-std is nan: it must be from 0 to 1000 m"),
        (["dataset", "a", "--noise-std", "1e308"], "--noise-std is 1e+308"),
        (["dataset", "a", "--seed", "-1"], "--seed is -1: it must not be below 0"),
        (["dataset", "a", "--workers", "-1"], "--workers"),
        (["drawings", "a", "--seed", "-1"], "--seed is -1: it must not be below 0"),
        (["magic"], "magic"),
        ([], "Missing command. (try: prim-train --help)"),
    ],
)
def test_impossible_options(run: Run, arguments: list[str], said: str) -> None:
    code, _, err = run(*arguments)
    assert code == 2 and said in err and err.count("\n") == 1


@pytest.mark.parametrize("command", [("dataset", "--maps", 1, 1, "--mapper", "det"), ("drawings", "--images", 1, 1)])
def test_a_folder_of_other_files_takes_no_set(run: Run, command: tuple[object, ...]) -> None:
    """They might have the names of its own."""
    Path("mine").mkdir()
    Path("mine/drawings.yaml").write_text("important: true")
    name, *options = command
    code, _, err = run(name, "mine", *options)
    assert (code, err.count("\n"), "mine holds drawings.yaml, which is of no set" in err) == (2, 1, True)
    assert [path.read_text() for path in Path("mine").iterdir()] == ["important: true"]


def test_the_presets_are_those_that_exist() -> None:
    from detect.training.dataset import DATASET_PRESETS

    assert {*cli.DatasetPreset} == DATASET_PRESETS.keys()
    pytest.importorskip("torch", reason="needs the extra [train]")
    from detect.training.train import CNN_PRESETS, YOLO_PRESETS

    assert {*cli.CnnPreset} == CNN_PRESETS.keys() and {*cli.YoloPreset} == YOLO_PRESETS.keys()


def test_yolo_trains_on_the_maps_of_every_mapper() -> None:
    assert {*cli.ImageSource} == {*MapperName, "drawings"}


@pytest.mark.parametrize("command", ["yolo", "cnn"])
def test_without_torch_the_extra_is_named(run: Run, monkeypatch: pytest.MonkeyPatch, command: str) -> None:
    monkeypatch.setattr(cli, "find_spec", lambda name: None)
    code, _, err = run(command, "set", "out")
    assert code == 2 and "pip install -e '.[train]'" in err and err.count("\n") == 1


@pytest.mark.parametrize(("app", "arguments"), [("train", ["all", "w"]), ("evaluation", ["w"])])
def test_suites_without_torch_name_the_extra(
    in_tmp: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    app: str,
    arguments: list[str],
) -> None:
    monkeypatch.setattr(cli, "find_spec", lambda name: None)
    assert console.run(getattr(cli, app), "prim", arguments) == 2
    assert "pip install -e '.[train]'" in capsys.readouterr().err and not list(in_tmp.iterdir())


def test_weights_that_can_run_code_must_be_trusted(run: Run) -> None:
    pytest.importorskip("torch", reason="needs the extra [train]")
    code, _, err = run("yolo", "set", "out", "--start", "a.pt")
    assert code == 2 and "--trust" in err


class RunsCode:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return exec, ("open('ran', 'w').close()",)


@pytest.mark.parametrize(
    ("app", "arguments"),
    [
        ("train", ["yolo", "set", "out/yolo", "--mapper", "det"]),
        ("train", ["all", "out"]),
        ("evaluation", ["out"]),
    ],
)
def test_an_interrupted_run_must_be_trusted_to_go_on(
    run: Run, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], app: str, arguments: list[str]
) -> None:
    """Its checkpoint is a pickle: nothing in it may run."""
    pytest.importorskip("torch", reason="needs the extra [train]")
    monkeypatch.setattr("detect.training.recipe.train_all", None)  # which would take hours
    monkeypatch.setattr("detect.evaluation.suites.PaperSuite", None)
    run("dataset", "set", "--maps", 1, 1, "--mapper", "det")
    last = Path("out") / "yolo" / "weights" / "last.pt"
    last.parent.mkdir(parents=True)
    last.write_bytes(pickle.dumps(RunsCode()))
    code = console.run(getattr(cli, app), "prim", arguments)
    err = capsys.readouterr().err
    assert code == 2 and "last.pt is a pickle" in err and "--trust" in err and err.count("\n") == 1
    assert not Path("ran").exists()


def test_an_export_replaces_networks_alone_and_never_its_input(run: Run) -> None:
    pytest.importorskip("torch", reason="needs the extra [train]")
    run("dataset", "set", "--maps", 2, 1, "--mapper", "prob", "--kind", "circle", "--noise-std", 0.0)
    run("cnn", "set", "out", "--mapper", "prob", "--kind", "circle", "--epochs", 1)
    checkpoint, notes = Path("out") / "cnn.prob.circle.pt", Path("notes.txt")
    notes.write_text("mine")
    before = checkpoint.read_bytes()
    options = ("--stage", "cnn", "--mapper", "prob")
    for force in ([], ["--force"]):
        code, _, err = run("export", checkpoint, checkpoint, *options, *force)
        assert code == 2 and "the input" in err and checkpoint.read_bytes() == before
    code, _, err = run("export", checkpoint, notes, *options)
    assert code == 2 and "--force" in err and err.count("\n") == 1 and notes.read_text() == "mine"
    for force in ([], [], ["--force"]):
        assert run("export", checkpoint, notes if force else "a.onnx", *options, *force)[0] == 0
    assert notes.read_bytes() == Path("a.onnx").read_bytes()
    code, _, err = run("export", checkpoint, Path("none") / "a.onnx", *options)
    assert code == 1 and "cannot write" in err and err.count("\n") == 1


def test_exported_weights_need_no_trust(run: Run) -> None:
    """They cannot run code; the missing data set is reported next."""
    pytest.importorskip("torch", reason="needs the extra [train]")
    code, _, err = run("yolo", "set", "out", "--start", "a.onnx")
    assert code == 2 and "--trust" not in err and "holds no set" in err


def test_a_network_learns_and_an_ended_run_is_not_repeated(run: Run) -> None:
    pytest.importorskip("torch", reason="needs the extra [train]")
    run("dataset", "set", "--maps", 6, 2, "--mapper", "prob", "--kind", "circle", "--noise-std", 0.0)
    options = ("--mapper", "prob", "--kind", "circle", "--epochs")
    code, out, _ = run("cnn", "set", "out", *options, 12)
    losses = [float(line.split("loss ")[1].split(",")[0]) for line in out.splitlines()]
    assert code == 0 and len(losses) == 12 and losses[-1] < losses[0]
    assert (Path("out") / "cnn.prob.circle.pt").exists()
    assert run("cnn", "set", "out", *options, 12)[1] == ""
    code, _, err = run("cnn", "set", "out", *options, 13)
    assert code == 2 and "other options" in err


def test_training_starts_from_given_weights(run: Run) -> None:
    """With a learning rate near zero the weights stay."""
    torch = pytest.importorskip("torch", reason="needs the extra [train]")
    from dataclasses import replace

    from detect.training.train import YoloOptions, train_yolo

    run("dataset", "set", "--maps", 4, 2, "--mapper", "det", "--kind", "circle", "--noise-std", 0.0)
    options = YoloOptions(epochs=1, batch=4, mosaic=False, turn=False, seed=3)
    start = train_yolo(Path("set"), "det", Path("a"), options)
    frozen = replace(options, start=start, trust=True, learning_rate=1e-9, seed=4)
    end = train_yolo(Path("set"), "det", Path("b"), frozen)

    def weights(path: Path) -> list[object]:
        state = torch.load(path, weights_only=False)["model"].float().state_dict()
        return [value for name, value in state.items() if name.endswith("conv.weight")]

    for before, after in zip(weights(start), weights(end), strict=True):
        assert torch.allclose(before, after, atol=1e-3)
    code, _, err = run("yolo", "set", "b", "--mapper", "det", "--epochs", 7)
    assert code == 2 and "with other options" in err

    # the exported network has ultralytics' own boxes and scores, thresholds and a model card
    command = ("export", start, "yolo.onnx", "--stage", "yolo", "--mapper", "det")
    assert "--set" in run(*command)[2] and "--trust" in run(*command, "--set", "set")[2]
    assert run(*command, "--set", "set", "--trust")[0] == 0
    exported = load_weights(Path("yolo.onnx"), "yolo", "det")
    assert run(*command, "--set", "set", "--trust")[0] == 0  # an earlier network is replaced
    assert set(exported.card.thresholds) == {"circle"} and exported.card.style == "rounded"
    images = np.random.default_rng(0).random((2, 3, TILE_SIZE, TILE_SIZE), dtype=np.float32)
    model = torch.load(start, weights_only=False)["model"].float().eval()
    with torch.no_grad():
        expected = model(torch.from_numpy(images))[0].numpy()
    outputs = exported.session.run(None, {"images": images})[0]
    assert outputs.shape == expected.shape == (2, 9, 1029)
    assert outputs[:, :4] == pytest.approx(expected[:, :4], abs=0.5)  # cells; weights are kept in half precision
    assert outputs[:, 4:] == pytest.approx(expected[:, 4:], abs=5e-3)

    # training continues from shipped weights too, and nothing in them is executed
    start = SHIPPED / "det" / "yolo.onnx"
    code, out, err = run("yolo", "set", "c", "--mapper", "det", "--epochs", 1, "--start", start)
    assert code == 0 and "wrote: c" in out, err
