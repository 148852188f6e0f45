"""Data sets: made from seeds, continued, checked against their options."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from detect.training.crops import collect_crops
from detect.training.dataset import (
    DATASET_PRESETS,
    DatasetOptions,
    data_description,
    image_style,
    load_samples,
    make_dataset,
    read_image,
    session_cell,
    session_options,
    session_seeds,
    write_image,
)
from prim.errors import OutputError, UsageError
from prim.shapes import Kind

SMALL = DatasetOptions(
    sizes=(2, 1), noise_stds=(0.05, 0.25), rays=(180,), stops=(5,), seed=7, mappers=("det", "forward")
)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sets") / "small"
    assert make_dataset(folder, SMALL) == 3
    return folder


def test_a_data_set_holds_images_labels_and_primitives(small: Path) -> None:
    for mapper in SMALL.mappers:
        train, val = load_samples(small, mapper, "train"), load_samples(small, mapper, "val")
        assert (len(train), len(val)) == (2, 1)
        for sample in train + val:
            image = read_image(sample)
            assert image.shape == (224, 224, 3)
            labels = sample.image.parents[3] / "labels" / mapper / sample.image.parent.name
            lines = (labels / f"{sample.image.stem}.txt").read_text().splitlines()
            assert len(lines) == len(sample.primitives)
    assert [sample.primitives for sample in load_samples(small, "det", "train")] == [
        sample.primitives for sample in load_samples(small, "forward", "train")
    ]


@pytest.mark.parametrize("name", ["set", "my set: #2", "gr\u00fc\u00df"])
def test_the_description_of_a_data_set_is_yaml_whatever_its_folder_is_called(tmp_path: Path, name: str) -> None:
    yaml = pytest.importorskip("ruamel.yaml", reason="comes with rosbags")
    found = yaml.YAML(typ="safe").load(data_description(tmp_path / name, "det"))
    assert found["path"] == str((tmp_path / name).resolve())
    assert found["train"] == "images/det/train"


def test_an_image_is_read_as_it_was_written(small: Path, tmp_path: Path) -> None:
    """In the same order of channels, by other readers of PNG files, too."""
    image = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    sample = replace(load_samples(small, "det", "val")[0], image=tmp_path / "a.png")
    write_image(sample.image, image)
    assert (read_image(sample) == image).all()
    assert (cv2.imread(str(sample.image))[..., ::-1] == image).all()
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


@pytest.mark.parametrize("content", [None, b"", b"\x89PNG\r\n\x1a\n", b"no image"])
def test_a_damaged_image_is_refused(small: Path, tmp_path: Path, content: bytes | None) -> None:
    sample = replace(load_samples(small, "det", "val")[0], image=tmp_path / "a.png")
    if content is not None:
        sample.image.write_bytes(content)
    with pytest.raises(UsageError, match=r"a\.png is missing or damaged"):
        read_image(sample)


def test_a_data_set_is_continued_and_reproducible(small: Path, tmp_path: Path) -> None:
    assert make_dataset(small, SMALL) == 0
    again = tmp_path / "again"
    make_dataset(again, SMALL, workers=1)
    done = next((again / "done" / "train").iterdir())
    done.unlink()
    assert make_dataset(again, SMALL) == 1
    for path in sorted(again.rglob("*.png")):
        assert path.read_bytes() == (small / path.relative_to(again)).read_bytes()


def test_a_folder_with_other_options_is_refused(small: Path) -> None:
    with pytest.raises(UsageError, match="other options"):
        make_dataset(small, DatasetOptions(sizes=(2, 1), seed=8))
    with pytest.raises(UsageError, match="no train set for prob"):
        load_samples(small, "prob", "train")


def test_sessions_follow_from_their_seeds() -> None:
    mixed = DatasetOptions(
        sizes=(30, 10), noise_stds=(0.0, 0.5), floors=(2.0, 5.0), motions=("warp", "drive"), walled=0.5
    )
    jobs = list(session_seeds(mixed))
    assert len({seed for _, seed in jobs}) == 40 and [split for split, _ in jobs].count("val") == 10
    drawn = [session_options(mixed, seed) for _, seed in jobs]
    assert drawn == [session_options(mixed, seed) for _, seed in jobs]
    assert {options.motion for options in drawn} == {"warp", "drive"}
    assert {options.lidar.noise_std for options in drawn} == {0.0, 0.5}
    assert {options.world.walls for options in drawn} == {True, False}
    assert {options.world.size for options in drawn} == {(2.0, 2.0), (5.0, 5.0)}


def test_the_manifest_holds_the_options(small: Path) -> None:
    manifest = json.loads((small / "manifest.json").read_text())
    assert (manifest["sizes"], manifest["seed"], manifest["mappers"]) == ([2, 1], 7, ["det", "forward"])


def test_crops_of_a_data_set_are_its_primitives(small: Path) -> None:
    train = load_samples(small, "forward", "train")
    counts = [len(collect_crops(train, kind)) for kind in Kind]
    assert sum(counts) == sum(len(sample.primitives) for sample in train)


@pytest.mark.parametrize("options", [{"mappers": ("magic",)}, {"sizes": (0, 0)}, {"rays": ()}, {"walled": 2.0}])
def test_impossible_options_are_refused(options: dict[str, object]) -> None:
    with pytest.raises(UsageError):
        DatasetOptions(**options)  # type: ignore[arg-type]


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"primitives": [{}], "frame": {}, "noise_std": 0}', "\xff"])
def test_a_damaged_set_is_named(tmp_path: Path, content: str) -> None:
    for name in ("truth/train/000003_0.json", "det.yaml", "manifest.json"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(content, encoding="latin-1")
    with pytest.raises(UsageError, match=r"000003_0\.json is damaged"):
        load_samples(tmp_path, "det", "train")
    if content[:1] != "{":
        with pytest.raises(UsageError, match="holds no set"):
            image_style(tmp_path, "det")


def test_files_of_a_set_are_replaced_whole(tmp_path: Path) -> None:
    """Who reads an earlier one, by a link to it here, does not see it change."""
    options = DatasetOptions((1, 0), mappers=("det",), kinds=("circle",), seed=3)
    make_dataset(tmp_path / "set", options)
    (done,) = (tmp_path / "set" / "done" / "train").iterdir()
    written = [path for path in (tmp_path / "set").rglob("*") if path.is_file() and path.parent != done.parent]
    (tmp_path / "links").mkdir()
    links = [tmp_path / "links" / f"{number}" for number in range(len(written))]
    for path, link in zip(written, links, strict=True):
        link.hardlink_to(path)
    done.unlink()
    make_dataset(tmp_path / "set", options)
    for path, link in zip(written, links, strict=True):
        assert not link.samefile(path) and link.read_bytes() == path.read_bytes()
    assert not list((tmp_path / "set").rglob("*.part"))


def test_a_file_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    """By the process that makes a session, whose errors come from another one."""
    options = DatasetOptions((1, 0), mappers=("det",), kinds=("circle",), seed=3)
    place = tmp_path / "images" / "det" / "train" / "000003_0.png"
    place.mkdir(parents=True)
    with pytest.raises(OutputError, match=r"000003_0\.png: cannot write"):
        make_dataset(tmp_path, options)


def test_cells_of_any_size_are_written_as_the_networks_know_them(tmp_path: Path) -> None:
    """Five times as large, in cells that are: outlines lie on occupied cells, and have the sizes of cells of 1 cm."""
    options = replace(
        DATASET_PRESETS["open"],
        sizes=(3, 0),
        mappers=("det",),
        noise_stds=(0.0,),
        scales=(5.0,),
        faulty=0.0,
        rays=(500,),
        fovs=(6.28,),
        stops=(8,),
        motions=("warp",),
        seed=31,
    )
    make_dataset(tmp_path / "set", options, workers=1)
    outlines = 0
    for sample in load_samples(tmp_path / "set", "det", "train"):
        occupied = read_image(sample)[..., 0] > 200
        near = cv2.dilate(occupied.astype(np.uint8), np.ones((5, 5), np.uint8))
        for primitive in sample.primitives:
            assert 0.04 < primitive.kind.extent * max(primitive.size) <= 0.5 + 1e-9
            places = primitive.outline() / sample.frame.resolution - (sample.frame.col, sample.frame.row)
            cols, rows = np.clip(places, 0, 223).astype(int).T
            assert near[rows, cols].mean() > 0.4
            outlines += 1
    assert outlines > 4
    assert {session_cell(options, seed) for _, seed in session_seeds(options)} == {0.05}


def test_sessions_of_earlier_presets_are_drawn_as_ever() -> None:
    """What real places have comes from generators of its own."""
    seed = 200_003
    old, more = session_options(DATASET_PRESETS["mixed"], seed), replace(DATASET_PRESETS["mixed"], clutter=(0, 4))
    new = session_options(replace(more, fovs=(3.0, 4.0), faulty=1.0), seed)
    assert (old.lidar.rays, old.lidar.noise_std, old.stops, old.motion) == (
        new.lidar.rays, new.lidar.noise_std, new.stops, new.motion,
    )  # fmt: skip
    assert new.lidar.fov in (3.0, 4.0) and new.lidar.faults != old.lidar.faults
