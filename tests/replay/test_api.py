"""The API: what a replay returns, and errors that name parameters."""

import dataclasses
import inspect
import json
import math
import typing
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

import prim
from mapping.grid import GridFrame, OccupancyGrid
from recorder.keywords import SWITCHES as RECORDING_SWITCHES
from recorder.keywords import RecordingKeywords
from recorder.session import Session
from replay import cli
from replay.api import Result
from replay.keywords import SWITCHES, ReplayKeywords
from replay.options import ReplayOptions
from replay.outputs.report import comparison_table, shared_rows
from replay.pipeline import Pipeline
from replay.result import distinct_notes


@pytest.fixture(scope="module")
def result(noisy_session: Session) -> Result:
    return prim.replay(str(noisy_session.path))


def test_a_replay_is_that_of_the_command_line(result: Result, noisy_session: Session, in_tmp: Path) -> None:
    """The default mapper and all other defaults are those of prim-replay."""
    from prim import console

    assert console.run(cli.app, "prim-replay", [str(noisy_session.path), "--no-viewer", "--quiet"]) == 0
    report = json.loads(Path("noisy.prob.report.json").read_text())
    assert {**report, "timing": None} == {**json.loads(json.dumps(result.report)), "timing": None}


def test_primitives_have_sizes_deviations_and_chances_by_name(result: Result) -> None:
    assert result.primitives and result.errors is not None
    for found in result.primitives:
        assert set(found.size) == set(found.kind.sizes) and found.std is not None and found.chances is not None
        assert found.chances[found.kind] == found.score and set(found.std) >= {"x", "y", *found.size}
        assert found.primitive.to_json().items() <= found.to_json().items()


def test_the_table_has_a_row_for_each_primitive(result: Result) -> None:
    rows = result.table().to_pylist()
    assert [row["id"] for row in rows] == [found.id for found in result.primitives]
    for row, found in zip(rows, result.primitives, strict=True):
        assert (row["kind"], row["x"], row["theta"]) == (found.kind, found.x, found.theta)
        assert {name: row[name] for name in found.size} == found.size
        assert row["std_x"] == found.std["x"] and row[f"chance_{found.kind}"] == found.score  # type: ignore[index]
        others = {name for kind in prim.Kind for name in kind.sizes} - set(found.size)
        assert all(row[name] is None and row[f"std_{name}"] is None for name in others)


def test_the_picture_shows_the_map_and_the_outlines(result: Result, tmp_path: Path) -> None:
    picture = result.plot()
    rows, cols, _ = picture.pixels.shape
    x0, y0, x1, y1 = result.grid.frame.bounds
    for found in result.primitives:
        vertex = found.primitive.outline()[0]
        col, row = round((vertex[0] - x0) / (x1 - x0) * cols), round((y1 - vertex[1]) / (y1 - y0) * rows)
        near = picture.pixels[row - 4 : row + 5, col - 4 : col + 5].reshape(-1, 3).astype(int)
        assert np.abs(near - found.kind.row.color).sum(axis=1).min() < 60, found
    picture.save(tmp_path / "a.png")
    read = cv2.cvtColor(cv2.imread(str(tmp_path / "a.png")), cv2.COLOR_BGR2RGB)
    assert np.array_equal(read, picture.pixels) and picture._repr_png_() == (tmp_path / "a.png").read_bytes()
    with pytest.raises(prim.OutputError, match="choose another place"):
        picture.save(tmp_path / "no" / "a.png")
    with pytest.raises(prim.UsageError, match=r"ends in \.png"):
        picture.save(tmp_path / "a.jpg")
    assert repr(picture) == f"Picture({cols} x {rows} pixels)"


def test_a_large_map_makes_a_picture_of_bounded_size(noisy_session: Session) -> None:
    bounds = (-30.0, -2.0, 2.0, 2.0)
    picture = prim.replay(noisy_session.path, bounds=bounds, detect=False).plot()
    assert picture.pixels.shape == (125, 1000, 3)


def test_poses_are_those_of_the_scans_that_have_one(result: Result, noisy_session: Session) -> None:
    assert result.poses.source == "truth" and not result.poses.matched
    assert result.poses.poses.shape == (noisy_session.scans, 3) and len(result.poses.stamps) == noisy_session.scans
    pairs = list(prim.posed_scans(str(noisy_session.path)))
    assert [scan.stamp for scan, _ in pairs] == result.poses.stamps.tolist()
    assert np.array([(p.x, p.y, p.theta) for _, p in pairs]) == pytest.approx(result.poses.poses)


def test_refinement_takes_guesses_of_any_detector(noisy_session: Session, quiet_session: Session) -> None:
    grid = prim.replay(quiet_session.path, detect=False).grid
    scans = list(prim.posed_scans(quiet_session.path))
    truth = quiet_session.world.primitives
    nowhere = prim.Primitive.of("circle", -0.9, 0.9, radius=0.05)
    guesses = [prim.Primitive.of(p.kind, p.x + 0.008, p.y - 0.008, p.theta, **p.sizes) for p in truth]
    refined = prim.refine([*guesses, nowhere], iter(scans), grid)
    assert refined[-1] is None
    for number, (found, true) in enumerate(zip(refined[:-1], truth, strict=True), 1):
        assert found is not None and (found.id, found.kind) == (number, true.kind)
        assert np.hypot(found.x - true.x, found.y - true.y) < 1e-3


def test_several_mappers_give_a_result_each(noisy_session: Session, tmp_path: Path) -> None:
    results = prim.replay_each(noisy_session.path, mapper="prob,det", save=tmp_path / "both.rrd", detect_every="end")
    assert list(results) == ["prob", "det"] and (tmp_path / "both.rrd").stat().st_size > 10_000
    for mapper, each in results.items():
        alone = prim.replay(noisy_session.path, mapper=mapper)
        assert np.array_equal(each.grid.probability, alone.grid.probability)
        assert each.report["primitives"] == alone.report["primitives"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"resolution": 0}, "resolution is 0: it must be above 0"),
        ({"resolution": 1e9}, r"resolution is 1e\+09: it must be above 0 and at most 100 m"),
        ({"resolution": "fine"}, "resolution is 'fine': input should be a valid number"),
        ({"resolution": True}, "resolution is True"),
        ({"detect_every": True}, "detect_every is True"),
        ({"n_scans": 1.5}, "n_scans is 1.5: input should be a valid integer"),
        ({"refine": "perhaps"}, "refine is 'perhaps': input should be a valid boolean"),
        ({"pose": "Truth"}, "pose is 'Truth': choose from auto, truth"),
        ({"mapper": "Prob"}, "no mapper 'Prob'"),
        ({"mapper": 5}, "mapper is 5"),
        ({"laser_offset": (-0.032, 0, 180)}, "laser_offset turns by 10313.2 degrees: it must be within a full turn"),
        ({"laser_offset": (0, 0, np.nan)}, "laser_offset turns by nan degrees"),
        ({"laser_offset": 0.3}, "laser_offset is 0.3"),
        ({"bounds": "0 0 1 1"}, "bounds is '0 0 1 1'"),
        ({"bounds": (1, 0, 0, 1)}, "bounds is 1 0 0 1: X0 must be below X1"),
        ({"weights": 5}, "weights is 5"),
        ({"no_detect": True}, "no parameter 'no_detect': give detect=False"),
        ({"sav": "a.rrd"}, "no parameter 'sav': did you mean save?"),
        ({"progress": 3}, "progress is 3: give a function"),
        ({"verbose": True}, "no parameter 'verbose'; there are"),
        ({"detect": False, "refine": False}, "detect=False excludes detect_every, weights and refine=False"),
        ({"standing_still": True, "pose": "tf"}, "standing_still=True excludes pose and odom_topic"),
        ({"bounds": (0, 1)}, r"bounds is \(0, 1\)"),
        ({"laser_offset": (0, 1)}, r"laser_offset is \(0, 1\)"),
        ({"fuse": ["sonar"]}, "fuse sonar: sonar is no sensor"),
        ({"n_scans": 0}, "n_scans is 0"),
        ({"mapper": "det,prob"}, "replay_each"),
        ({"maper": "det"}, "no parameter 'maper': did you mean mapper?"),
        ({"detect_every": "often"}, "detect_every is 'often'"),
        ({"scan_topic": "/nothing"}, "no LaserScan on /nothing"),
    ],
)
def test_errors_name_parameters(noisy_session: Session, options: dict[str, object], message: str) -> None:
    with pytest.raises(prim.PrimError, match=message) as error:
        prim.replay(noisy_session.path, **options)  # type: ignore[arg-type]
    assert "--" not in str(error.value)


@pytest.mark.parametrize(
    "call",
    [
        lambda: prim.replay(None),  # type: ignore[arg-type]
        lambda: prim.replay(""),
        lambda: prim.replay(b"log.mcap"),  # type: ignore[arg-type]
        lambda: prim.record(""),
        lambda: prim.posed_scans("log.mcap", foo=1),  # type: ignore[call-arg]
        lambda: prim.make_mapper("prob", -0.02),
        lambda: prim.make_mapper("prob", 0),
        lambda: prim.make_mapper("forward", float("nan")),
        lambda: prim.make_mapper("prob", bounds=(1, 1, 0, 0)),
        lambda: prim.make_mapper("prob", bounds="auto"),  # type: ignore[arg-type]
        lambda: prim.make_mapper("magic"),
        lambda: prim.make_mapper("prob", sensor_model="gaussian"),
        lambda: prim.Primitive.of("hexagon", 0, 0, side=0.1),
        lambda: prim.Primitive.of("circle", 0, 0, side=0.1),
        lambda: prim.Primitive.of("circle", 0, 0, radius=-0.1),
        lambda: prim.Primitive.of("square", 0, 0, side=0.1),
    ],
)
def test_mistakes_are_expected_errors(call: Callable[[], object], in_tmp: Path) -> None:
    with pytest.raises(prim.PrimError) as error:
        call()
    assert "--" not in str(error.value) and "\n" not in str(error.value)
    assert not list(Path().iterdir())


def test_refinement_says_what_it_cannot_take(result: Result, noisy_session: Session) -> None:
    scans, guess = list(prim.posed_scans(noisy_session.path)), result.primitives[0]
    for arguments in (
        ([guess], scans, result.grid, -1.0),
        ([guess], scans, result.grid.probability),
        ([(1, 2)], scans, result.grid),
        ([guess], [scan for scan, _ in scans], result.grid),
        ([guess], str(noisy_session.path), result.grid),
        (result, scans, result.grid),
        (guess, scans, result.grid),
        ([guess], scans, result.grid, "a"),
    ):
        with pytest.raises(prim.UsageError):
            prim.refine(*arguments)  # type: ignore[arg-type]


def test_of_guesses_that_overlap_the_first_is_fitted(quiet_session: Session) -> None:
    grid, scans = prim.replay(quiet_session.path, detect=False).grid, list(prim.posed_scans(quiet_session.path))
    true = quiet_session.world.primitives[0]
    near = prim.Primitive.of(true.kind, true.x + 0.01, true.y, true.theta, **true.sizes)
    alone, fitted, *others = [*prim.refine([near], scans, grid), *prim.refine([near, near, true], scans, grid)]
    assert others == [None, None] and alone is not None and alone == fitted


def test_a_recording_is_never_saved_over_the_log(noisy_session: Session, tmp_path: Path) -> None:
    log = tmp_path / "log.mcap"
    log.write_bytes(noisy_session.path.read_bytes())
    with pytest.raises(prim.UsageError, match="is the input"):
        prim.replay(log, save=tmp_path / "." / "log.mcap")
    assert log.read_bytes() == noisy_session.path.read_bytes()


def test_values_may_be_text_and_numbers_of_numpy(noisy_session: Session) -> None:
    calls: list[int] = []
    result = prim.replay(
        noisy_session.path,
        resolution="0.05",  # type: ignore[arg-type]
        n_scans=np.int64(3),  # type: ignore[arg-type]
        bounds=np.array([-1.0, -1.0, 1.0, 1.0]),  # type: ignore[arg-type]
        detect=False,
        progress=lambda done, total: calls.append(done),
    )
    assert result.grid.frame.shape == (40, 40) and calls == [1, 2, 3]
    assert repr(result) == "Result(0 primitives in 40 x 40 cells of prob, 3 scans, poses: truth)"


def test_each_mapper_has_the_time_of_its_own_stages(noisy_session: Session) -> None:
    """Stages do not overlap, and what the mappers share counts for each: totals are at most the elapsed time."""
    results = Pipeline(noisy_session.path, ReplayOptions(mapper="det,prob,forward")).run_each()
    for result in results:
        stages = {name: seconds for name, seconds in result.seconds.items() if name != "total"}
        assert sum(stages.values()) <= result.seconds["total"] <= result.elapsed == results[0].elapsed
        others = sum(other.seconds["map"] + other.seconds["refine"] for other in results if other is not result)
        assert result.seconds["total"] <= result.elapsed - others
    assert dict(shared_rows(results))["time"] == f"{results[0].elapsed:.2f} s"


def test_each_mapper_takes_the_noise_and_the_sensor_model_that_it_can() -> None:
    options = ReplayOptions(mapper="det,prob,forward", noise_std=0.1, sensor_model="gaussian")
    taken = [(each.mapper, each.sensor_model, each.noise_std) for each in options.by_mapper()]
    assert taken == [("det", "eq4", None), ("prob", "gaussian", 0.1), ("forward", "eq4", 0.1)]
    assert [each.noise_std for each in ReplayOptions(mapper="prob,forward", noise_std=0.2).by_mapper()] == [None, 0.2]


def test_notes_of_several_mappers_are_said_once(noisy_session: Session) -> None:
    results = Pipeline(noisy_session.path, ReplayOptions(mapper="det,prob", bounds=(9, 9, 10, 10))).run_each()
    assert all(result.notes for result in results) and len(distinct_notes(results)) == len(results[0].notes)


def test_a_comparison_has_no_empty_columns(noisy_session: Session) -> None:
    results = Pipeline(noisy_session.path, ReplayOptions(mapper="det,prob", detect=False)).run_each()
    names, units, *rows = comparison_table(results)
    assert names == ["mapper", "map F1", "AUC", "mapping"] and len(units) == 4
    assert [row[0] for row in rows] == ["det", "prob"] and all(all(row) for row in rows)


def test_names_of_files_are_not_translated(in_tmp: Path) -> None:
    with pytest.raises(prim.LogReadError) as error:
        prim.replay("x--end.mcap")
    assert str(error.value).startswith("x--end.mcap: cannot open")


def test_none_is_as_if_it_were_not_given(noisy_session: Session, tmp_path: Path) -> None:
    given = dict.fromkeys(ReplayKeywords.__annotations__) | {"detect": False}
    result = prim.replay(noisy_session.path, **given)  # type: ignore[arg-type]
    assert result.report["map"]["mapper"] == "prob"
    session = prim.record(tmp_path / "a.mcap", **dict.fromkeys(RecordingKeywords.__annotations__))  # type: ignore[arg-type]
    assert session.scans > 50


def test_several_mappers_may_be_a_list(noisy_session: Session) -> None:
    assert list(prim.replay_each(noisy_session.path, mapper=["det", "prob"], detect=False)) == ["det", "prob"]


def test_log_errors_keep_their_parts(tmp_path: Path) -> None:
    (tmp_path / "cut.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(5))
    with pytest.raises(prim.LogReadError, match="recover=True") as error:
        list(prim.posed_scans(tmp_path / "cut.mcap"))
    assert error.value.hint == "read what is left of it with recover=True" and error.value.what in str(error.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"per_kind": (3, 1)}, "per_kind 3-1 is not a range"),
        ({"kinds": ["pentagon"]}, "kinds pentagon"),
        ({"movable": True}, "movable=True does not go with motion warp"),
        ({"world": "w.json", "walls": False}, "world excludes walls=False"),
        ({"arena": (0, 1)}, "arena is 0: it must be above 0"),
        ({"motion": "fly"}, "motion fly"),
        ({"colour": "red"}, "no parameter 'colour'"),
        ({"stops": 2}, "stops is 2"),
        ({"arena": "2x2"}, "arena is '2x2'"),
        ({"seed": -1}, "seed is -1: it must not be below 0"),
        ({"per_kind": "many"}, "per_kind is 'many'"),
        ({"rays": 3.5}, "rays is 3.5"),
        ({"world": {}}, "world is {}"),
        ({"fov": 360}, "20626.5 degrees, 360 rad"),
    ],
)
def test_errors_of_recordings_name_parameters(tmp_path: Path, options: dict[str, object], message: str) -> None:
    with pytest.raises(prim.UsageError, match=message):
        prim.record(tmp_path / "a.mcap", **options)  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


def test_a_recording_is_that_of_the_command_line(tmp_path: Path) -> None:
    from prim import console
    from recorder import cli as recorder_cli

    command = [str(tmp_path / "a.mcap"), "--seed", "4", "--rays", "90", "--stops", "3", "3", "--quiet"]
    assert console.run(recorder_cli.app, "prim-record", command) == 0
    prim.record(str(tmp_path / "b.mcap"), seed=4, rays=90, stops=(3, 3))
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_switches_are_the_keywords_that_are_true_or_false() -> None:
    for keywords, switches in ((ReplayKeywords, SWITCHES), (RecordingKeywords, RECORDING_SWITCHES)):
        hints = typing.get_type_hints(keywords)
        assert {name for name, hint in hints.items() if bool in (hint, *typing.get_args(hint))} == switches


def test_the_options_of_the_command_line_are_keywords() -> None:
    """All but those that say where outputs go, and what is printed."""
    outputs = {"logs", "save", "spawn", "connect", "serve", "no_viewer", "report", "map_output", "trajectory"}
    outputs |= {"context", "serve_host", "force"}
    printed = {"quiet", "verbose", "debug", "version", "list_topics", "as_json"}
    options = set(inspect.signature(cli.replay).parameters) - outputs - printed
    assert {name.removeprefix("no_") for name in options} == set(ReplayKeywords.__annotations__)


@pytest.mark.parametrize("value", [1e300, 1e-300, math.nan, math.inf])
def test_absurd_values_are_refused(value: float) -> None:
    for call in (
        lambda: prim.make_mapper("det", resolution=value),
        lambda: prim.make_mapper("forward", noise_std=value),
        lambda: prim.make_mapper("prob", sensor_model="gaussian", noise_std=value),
        lambda: prim.refine([], [], GRID, noise_std=value),
        lambda: prim.replay("none.mcap", rate=value),
        lambda: prim.replay("none.mcap", pose="fused", pose_noise=(value, 1.0)),
        lambda: prim.replay("none.mcap", pose="fused", odom_noise=(1.0, value)),
    ):
        with pytest.raises(prim.UsageError):
            call()


@pytest.mark.parametrize("mapper", ["det", "prob", "forward"])
@pytest.mark.parametrize("pose", [(1e300, 0.0, 0.0), (math.nan, 0.0, 0.0), (0.0, 0.0, math.inf), (0.0, -1e12, 0.0)])
def test_growing_maps_refuse_places_that_cannot_be(mapper: str, pose: tuple[float, float, float]) -> None:
    made = prim.make_mapper(mapper, 0.1)
    scan = prim.Scan(0, "laser", 0.0, 0.1, 0.1, 5.0, np.ones(9, np.float32))
    with pytest.raises(prim.UsageError, match="the laser's"):
        made.update(scan, prim.Pose2D(*pose))
    with pytest.raises(prim.UsageError, match="the scan cannot be used"):
        made.update(dataclasses.replace(scan, angle_min=math.nan), prim.Pose2D())


GRID = OccupancyGrid(GridFrame(0.1, 0, 0, 4, 4), np.full((4, 4), 0.5, np.float32))
