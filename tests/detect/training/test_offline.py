"""ultralytics writes nothing into the home, opens no connection and runs nothing that lies in a data set."""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from detect.training.dataset import DatasetOptions, make_dataset

TRAIN = """
import socket, sys
from pathlib import Path

def refuse(*arguments, **named):
    Path("asked").touch()
    raise OSError("no network")

socket.getaddrinfo = socket.socket.connect = refuse

from detect.training.train import YoloOptions, train_yolo

if __name__ == "__main__":
    train_yolo(Path("set"), "det", Path("out"), YoloOptions(epochs=1, batch=4, mosaic=False, turn=False))
    import ultralytics
    from ultralytics.utils import AUTOINSTALL
    from ultralytics.utils.callbacks import platform

    assert not AUTOINSTALL and not platform.callbacks
    assert not any(value is True for value in ultralytics.settings.values())
"""


class RunsCode:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return exec, ("open('ran', 'w').close()",)


def test_training_leaves_home_and_network_alone_and_runs_nothing_of_a_data_set(in_tmp: Path) -> None:
    """A set's list of labels is a pickle, and its description may hold a script: nobody asks for trust in a set."""
    pytest.importorskip("torch", reason="needs the extra [train]")
    pytest.importorskip("ultralytics", reason="needs the extra [train]")
    make_dataset(Path("set"), DatasetOptions((4, 2), mappers=("det",), kinds=("circle",)))
    for split in ("train", "val"):
        np.save(in_tmp / "cache.npy", np.array(RunsCode(), dtype=object), allow_pickle=True)
        Path("cache.npy").rename(Path("set") / "labels" / "det" / f"{split}.cache")
    description = Path("set") / "det.yaml"
    script = "download: open('ran', 'w').close()\n"
    description.write_text(description.read_text().replace("images/det/val", "images/none") + script)
    Path("home").mkdir()
    Path("temporary").mkdir()
    Path("train.py").write_text(TRAIN)
    kept = {
        name: value for name, value in os.environ.items() if not name.startswith(("YOLO", "MPL", "PYTEST", "XDG"))
    }
    home = {
        "HOME": str(in_tmp / "home"),
        "TMPDIR": str(in_tmp / "temporary"),
        "PYTHONPATH": str(Path(__file__).parents[3]),
        "ULTRALYTICS_API_KEY": "with which ultralytics would upload the run",
    }
    done = subprocess.run([sys.executable, "train.py"], env=kept | home, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert not Path("ran").exists() and not Path("asked").exists()
    assert not list(Path("home").iterdir()) and not list(Path("temporary").glob("prim-train-*"))


def test_settings_that_the_user_keeps_elsewhere_stay_as_they_are(in_tmp: Path) -> None:
    """ultralytics makes them where there are none, and its own update would write what is switched off here."""
    pytest.importorskip("torch", reason="needs the extra [train]")
    pytest.importorskip("ultralytics", reason="needs the extra [train]")
    code = "from detect.training.offline import load_ultralytics; assert not load_ultralytics().settings['sync']"
    environment = os.environ | {"YOLO_CONFIG_DIR": str(in_tmp)}
    subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[3], env=environment, check=True)
    (settings,) = in_tmp.rglob("settings.json")
    assert json.loads(settings.read_text())["sync"] is True


def test_an_imported_network_is_not_taken_from_an_earlier_run(in_tmp: Path) -> None:
    pytest.importorskip("torch", reason="needs the extra [train]")
    pytest.importorskip("ultralytics", reason="needs the extra [train]")
    from detect.networks.weights import SHIPPED
    from detect.training.train import YoloOptions, train_yolo

    make_dataset(Path("set"), DatasetOptions((4, 2), mappers=("det",), kinds=("circle",)))
    Path("out").mkdir()
    (Path("out") / "start.pt").write_bytes(pickle.dumps(RunsCode()))
    start = SHIPPED / "det" / "yolo.onnx"
    options = YoloOptions(epochs=1, batch=4, mosaic=False, turn=False, start=start)
    assert train_yolo(Path("set"), "det", Path("out"), options).exists()
    assert not Path("ran").exists()


@pytest.mark.parametrize("content", [b"", b"junk", pickle.dumps(RunsCode())])
def test_damaged_files_of_a_run_are_one_line(in_tmp: Path, content: bytes) -> None:
    pytest.importorskip("torch", reason="needs the extra [train]")
    from detect.training.export import export_cnn
    from detect.training.train import CNN_PRESETS, YoloOptions, train_cnn, train_yolo
    from prim.errors import UsageError
    from prim.shapes import Kind

    make_dataset(Path("set"), DatasetOptions((4, 2), mappers=("det",), kinds=("circle",)))
    Path("cnn.pt").write_bytes(content)
    with pytest.raises(UsageError, match=r"cnn\.pt is no checkpoint of prim-train cnn"):
        train_cnn(Path("set"), "det", [Kind.CIRCLE], Path("cnn.pt"), CNN_PRESETS["prim"])
    assert Path("cnn.pt").read_bytes() == content
    with pytest.raises(UsageError, match=r"cnn\.pt is no checkpoint of prim-train cnn"):
        options = replace(CNN_PRESETS["prim"], start=Path("cnn.pt"))
        train_cnn(Path("set"), "det", [Kind.CIRCLE], Path("new.pt"), options)
    with pytest.raises(UsageError, match=r"cnn\.pt is no checkpoint of prim-train cnn"):
        export_cnn(Path("cnn.pt"), "det", Path("cnn.onnx"))
    assert not Path("ran").exists()
    Path("out").mkdir()
    (Path("out") / "asked.json").write_bytes(content)
    with pytest.raises(UsageError, match=r"asked\.json is damaged"):
        train_yolo(Path("set"), "det", Path("out"), YoloOptions())
