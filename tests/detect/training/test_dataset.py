"""Training sets: made from seeds, gone on with, checked."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from detect.training.crops import gather
from detect.training.dataset import SetOptions, make, samples, session_options, sessions
from prim.errors import UsageError
from prim.shapes import Kind

SMALL = SetOptions(sizes=(2, 1), noise_stds=(0.05, 0.25), rays=(180,), stops=(5,), seed=7, mappers=("det", "forward"))


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sets") / "small"
    assert make(folder, SMALL) == 3
    return folder


def test_a_set_holds_what_it_says(small: Path) -> None:
    for mapper in SMALL.mappers:
        train, val = samples(small, mapper, "train"), samples(small, mapper, "val")
        assert (len(train), len(val)) == (2, 1)
        for sample in train + val:
            image = np.asarray(Image.open(sample.image))
            assert image.shape == (224, 224, 3)
            labels = sample.image.parents[3] / "labels" / mapper / sample.image.parent.name
            lines = (labels / f"{sample.image.stem}.txt").read_text().splitlines()
            assert len(lines) == len(sample.primitives)
    assert [sample.primitives for sample in samples(small, "det", "train")] == [
        sample.primitives for sample in samples(small, "forward", "train")
    ]


def test_a_set_goes_on_where_it_stopped_and_is_the_same_again(small: Path, tmp_path: Path) -> None:
    assert make(small, SMALL) == 0
    again = tmp_path / "again"
    make(again, SMALL, workers=1)
    done = next((again / "done" / "train").iterdir())
    done.unlink()
    assert make(again, SMALL) == 1
    for path in sorted(again.rglob("*.png")):
        assert path.read_bytes() == (small / path.relative_to(again)).read_bytes()


def test_another_set_is_not_mixed_in(small: Path) -> None:
    with pytest.raises(UsageError, match="other options"):
        make(small, SetOptions(sizes=(2, 1), seed=8))
    with pytest.raises(UsageError, match="no train set for prob"):
        samples(small, "prob", "train")


def test_sessions_follow_from_their_seeds() -> None:
    mixed = SetOptions(
        sizes=(30, 10), noise_stds=(0.0, 0.5), floors=(2.0, 5.0), motions=("warp", "drive"), walled=0.5
    )
    jobs = list(sessions(mixed))
    assert len({seed for _, seed in jobs}) == 40 and [split for split, _ in jobs].count("val") == 10
    drawn = [session_options(mixed, seed) for _, seed in jobs]
    assert drawn == [session_options(mixed, seed) for _, seed in jobs]
    assert {options.motion for options in drawn} == {"warp", "drive"}
    assert {options.lidar.noise_std for options in drawn} == {0.0, 0.5}
    assert {options.world.walls for options in drawn} == {True, False}
    assert {options.world.size for options in drawn} == {(2.0, 2.0), (5.0, 5.0)}


def test_the_manifest_tells_the_options(small: Path) -> None:
    manifest = json.loads((small / "manifest.json").read_text())
    assert (manifest["sizes"], manifest["seed"], manifest["mappers"]) == ([2, 1], 7, ["det", "forward"])


def test_crops_of_a_set(small: Path) -> None:
    train = samples(small, "forward", "train")
    counts = [len(gather(train, kind)) for kind in Kind]
    assert sum(counts) == sum(len(sample.primitives) for sample in train)


@pytest.mark.parametrize("options", [{"mappers": ("magic",)}, {"sizes": (0, 0)}, {"rays": ()}, {"walled": 2.0}])
def test_impossible_sets(options: dict[str, object]) -> None:
    with pytest.raises(UsageError):
        SetOptions(**options)  # type: ignore[arg-type]
