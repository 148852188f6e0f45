import json
import math
import os
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from rosbags.typesys import Stores, get_typestore

from prim import console
from prim.errors import UsageError, WorldError
from prim.log import open_log
from prim.log.decoding.values import planar_pose
from prim.log.messages import GPS_TOPIC, SCAN_TOPIC, TRUE_POSE_TOPIC
from prim.scan import Scan
from prim.se2 import Pose2D
from prim.shapes import Kind, Primitive
from prim.world import World
from recorder import session
from recorder.cli import app
from recorder.sensors import Compass, Gps, Lidar
from recorder.session import Session, SessionOptions, record_session
from recorder.simulator import Simulator, SimulatorOptions
from recorder.world import WorldOptions, draw_world
from replay.ground_truth import GroundTruth

STORE = get_typestore(Stores.ROS2_JAZZY)
FIXTURES = Path(__file__).parents[1] / "fixtures"
ROBOT_RADIUS = SimulatorOptions().robot_radius


def prim_record(*arguments: object) -> int:
    return console.run(app, "prim-record", [str(argument) for argument in arguments])


def test_an_interrupted_recording_ends_with_a_whole_step(
    in_tmp: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    encode, scans = session.encode_scan, []

    def interrupted_encode(scan: Scan) -> bytes:
        scans.append(scan)
        if len(scans) == 3:
            os.kill(os.getpid(), signal.SIGTERM)
        return encode(scan)

    monkeypatch.setattr(session, "encode_scan", interrupted_encode)
    assert prim_record("a.mcap", "--stops", 4, 4) == 143
    (part,) = in_tmp.resolve().iterdir()
    line = f"prim-record: error: interrupted: what was recorded until then is in {part}\n"
    assert capsys.readouterr().err == line
    with open_log(part) as log:
        assert {log.topics[topic].messages for topic in (SCAN_TOPIC, GPS_TOPIC, TRUE_POSE_TOPIC)} == {3}


def test_the_same_options_write_the_same_bytes(tmp_path: Path) -> None:
    options = SessionOptions(seed=4, stops=(3, 3))
    first, second = (record_session(tmp_path / name, options).path.read_bytes() for name in ("a.mcap", "b.mcap"))
    assert first == second
    assert record_session(tmp_path / "c.mcap", SessionOptions(seed=5, stops=(3, 3))).path.read_bytes() != first


def test_more_noise_changes_neither_world_nor_poses(tmp_path: Path) -> None:
    def recorded(noise: float) -> tuple[World, list[Pose2D], np.ndarray]:
        session = record_session(
            tmp_path / "a.mcap", SessionOptions(seed=4, stops=(3, 3), lidar=Lidar(noise_std=noise))
        )
        with open_log(session.path) as log:
            poses = [planar_pose(p) for _, (p,) in log.decoded(log.topics[TRUE_POSE_TOPIC])]
            ranges = np.array([scan.ranges for _, scan in log.decoded(log.topics[SCAN_TOPIC])])
        return session.world, poses, ranges

    quiet, loud = recorded(0.0), recorded(0.1)
    assert quiet[:2] == loud[:2]
    twice = recorded(0.2)[2]
    finite = np.isfinite(twice) & np.isfinite(loud[2])
    assert (twice - quiet[2])[finite] == pytest.approx(2 * (loud[2] - quiet[2])[finite], abs=1e-5)


@pytest.mark.parametrize("seed", range(8))
def test_worlds_are_as_the_paper_draws_them(seed: int) -> None:
    world = draw_world(np.random.default_rng(seed), WorldOptions())
    outlines = [shapely.Polygon(primitive.outline()) for primitive in world.primitives]
    assert all(not a.intersects(b) for i, a in enumerate(outlines) for b in outlines[:i])
    assert all(shapely.box(-1, -1, 1, 1).contains(outline) for outline in outlines)
    for kind in Kind:
        assert sum(primitive.kind is kind for primitive in world.primitives) <= 2
    assert len(world.walls) == 4


def test_sizes_fill_the_papers_ranges() -> None:
    """III-B in millimetres: smallest and largest of many drawn are near the ends of their ranges."""
    rng = np.random.default_rng(0)
    ranges = {
        Kind.SQUARE: [(0.08, 0.30)],
        Kind.RECTANGLE: [(0.06, 0.32)] * 2,
        Kind.CIRCLE: [(0.05, 0.30)],
        Kind.ELLIPSE: [(0.02, 0.16)] * 2,
    }
    for kind, limits in ranges.items():
        worlds = [
            draw_world(rng, WorldOptions((3, 3), kinds=(kind,), per_kind=(4, 4), walls=False)) for _ in range(60)
        ]
        sizes = np.array([primitive.size for world in worlds for primitive in world.primitives])
        low, high = min(limit[0] for limit in limits), max(limit[1] for limit in limits)
        assert low <= sizes.min() < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < sizes.max() <= high
    worlds = [draw_world(rng, WorldOptions(kinds=(Kind.TRIANGLE,), per_kind=(2, 2))) for _ in range(60)]
    base, height = np.array([primitive.size for world in worlds for primitive in world.primitives]).T
    leg = np.hypot(base / 2, height)
    assert base.min() >= 0.1 and base.max() <= 0.3
    assert leg.min() >= 0.1 - 1e-9 and leg.max() <= 0.3 + 1e-9
    assert height.min() >= 0.06


def test_worlds_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="do not fit"):
        draw_world(np.random.default_rng(0), WorldOptions((0.5, 0.5), per_kind=(9, 9)))


def test_the_robot_keeps_clear_of_everything(quiet_session: Session) -> None:
    outlines = [shapely.Polygon(primitive.outline()) for primitive in quiet_session.world.primitives]
    with open_log(quiet_session.path) as log:
        topic = log.topics[TRUE_POSE_TOPIC]
        poses = [planar_pose(pose) for _, (pose,) in log.decoded(topic)]
    assert len(poses) == quiet_session.scans
    assert len(poses) + quiet_session.skipped == 100
    stops = {(round(10 * pose.x + 9.5) / 2, round(10 * pose.y + 9.5) / 2) for pose in poses}
    assert len(stops) == len(poses)
    for pose in poses:
        assert all(outline.distance(shapely.Point(pose.x, pose.y)) > ROBOT_RADIUS for outline in outlines)


def test_stops_inside_a_primitive_or_touching_it_are_skipped() -> None:
    circle = Primitive(Kind.CIRCLE, 0.0, 0.0, None, (0.1,))
    simulator = Simulator(World((2.0, 2.0), (circle,)).with_walls())
    assert not simulator.warp(Pose2D(0.0, 0.0))
    assert not simulator.warp(Pose2D(0.1 + ROBOT_RADIUS - 1e-3, 0.0))
    assert simulator.warp(Pose2D(0.1 + ROBOT_RADIUS + 1e-3, 0.0))
    assert not simulator.warp(Pose2D(0.98, 0.0))


def test_exact_ranges_are_those_of_the_world(quiet_session: Session) -> None:
    with open_log(quiet_session.path) as log:
        _, scan = next(log.decoded(log.topics[SCAN_TOPIC]))
        topic = log.topics[TRUE_POSE_TOPIC]
        _, (stamped,) = next(log.decoded(topic))
    pose = planar_pose(stamped)
    bearings = np.linspace(-3.14, 3.14, 500) + pose.theta
    exact = quiet_session.world.cast((pose.x, pose.y), np.column_stack((np.cos(bearings), np.sin(bearings))))
    assert scan.ranges == pytest.approx(exact, abs=2e-6)
    assert (scan.range_min, scan.range_max) == pytest.approx((0.032, 5.0))


def test_ranges_beyond_the_limits_follow_rep_117() -> None:
    """In the open, with a circle near: noise of 0.5 m pushes some beams below range_min."""
    world = World((2.0, 2.0), (Primitive(Kind.CIRCLE, 0.5, 0.0, None, (0.3,)),))
    scan = Lidar(noise_std=0.5).measure(world, Pose2D(), 0, 0.1, np.random.default_rng(0))
    exact = Lidar().exact(world, Pose2D())
    assert np.isposinf(scan.ranges[np.isinf(exact)]).all()
    assert np.isneginf(scan.ranges).any()
    finite = scan.ranges[np.isfinite(scan.ranges)]
    assert finite.min() >= np.float32(0.032) and finite.max() <= 5.0


@pytest.mark.parametrize(("noise", "std"), [(0.0, 0.0), (0.05, 0.05), (0.25, 0.25)])
def test_noise_has_its_standard_deviation(noise: float, std: float) -> None:
    world = World((4.0, 4.0)).with_walls()
    lidar = Lidar(rays=20_000, noise_std=noise)
    scan = lidar.measure(world, Pose2D(), 0, 0.1, np.random.default_rng(1))
    errors = scan.ranges - lidar.exact(world, Pose2D())
    assert errors.std() == pytest.approx(std, rel=0.03, abs=1e-6)
    assert errors.mean() == pytest.approx(0, abs=max(std, 1e-4) * 0.03)


def test_gps_and_compass_noise() -> None:
    rng = np.random.default_rng(0)
    fixes = np.array([Gps(0.1).measure(Pose2D(1, 2, 0), rng) for _ in range(4000)])
    assert fixes.mean(axis=0) == pytest.approx([1, 2], abs=0.01)
    assert fixes.std(axis=0) == pytest.approx([0.1, 0.1], rel=0.05)
    headings = [Compass(0.05).measure(Pose2D(0, 0, 1), rng) for _ in range(4000)]
    assert np.std(headings) == pytest.approx(0.05, rel=0.05)


def test_the_log_holds_options_and_world(quiet_session: Session) -> None:
    with open_log(quiet_session.path) as log:
        described = log.metadata["prim"]
        world = log.attachment("world.json")
        markers = next(iter(log.messages("/ground_truth/primitives"))).data
    assert json.loads(described["seed"]) == 11
    assert json.loads(described["lidar"])["noise_std"] == 0.0
    assert World.from_json(json.loads(world or b"")) == quiet_session.world
    texts = [
        json.loads(marker.text)
        for marker in STORE.deserialize_cdr(markers, "visualization_msgs/msg/MarkerArray").markers
    ]
    assert sorted(text["kind"] for text in texts if "kind" in text) == sorted(Kind)


def test_metadata_keep_their_keys_and_name_options_that_are_not_the_defaults(tmp_path: Path) -> None:
    options = SessionOptions(motion="drive", duration=1.0, lidar=Lidar(rays=3), world=WorldOptions(per_kind=(0, 0)))
    described = []
    for name, chosen in (("a", options), ("b", replace(options, simulator=SimulatorOptions(tyre_friction=0.5)))):
        with open_log(record_session(tmp_path / f"{name}.mcap", chosen).path) as log:
            described.append(log.metadata["prim"])
    common = {"version", "seed", "world", "world_file", "motion", "duration", "speed", "movable", "rate"}
    assert described[0].keys() == common | {"lidar", "gps", "compass", "odometry"}
    assert json.loads(described[0]["odometry"]) == {"metres": 0.05, "radians": math.radians(2)}
    assert described[1].keys() == described[0].keys() | {"simulator"}
    simulator = json.loads(described[1]["simulator"])
    assert (simulator["tyre_friction"], simulator["axle"]) == (0.5, SimulatorOptions().track_width)


def test_sessions_of_today_are_those_of_earlier_versions(tmp_path: Path) -> None:
    """New causes of chance and new options change nothing where they are not asked for: the fixtures' first line."""
    arguments = "--seed 21 --stops 4 4 --rays 120 --per-kind 0-1 --noise-std 0.02 --quiet"
    assert prim_record(tmp_path / "warped.mcap", *arguments.split()) == 0
    contents = []
    for path in (tmp_path / "warped.mcap", FIXTURES / "0.2" / "warped.mcap"):
        with open_log(path) as log:
            messages = {topic: [message.data for message in log.messages(topic)] for topic in sorted(log.topics)}
            metadata = {key: value for key, value in log.metadata["prim"].items() if key != "version"}
            contents.append((messages, metadata, log.attachment("world.json")))
    assert contents[0] == contents[1]


def test_what_is_drawn_is_in_the_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.mcap"
    code = prim_record(
        *(path, "--seed", 3, "--clutter", "2-3", "--room", "furniture,L", "--at-walls", 0.02, "--size", 4, 4),
        *("--per-kind", 1, "--stops", 3, 3, "--rays", 90, "--range-bias", -0.02, "--beam-width", 1.5),
        *("--quantum", 0.01, "--dropout", 0.2, "--dropout-as", "max", "--outliers", 0.01, "--noise-growth", 0.01),
    )
    assert code == 0
    said = capsys.readouterr().out
    for words in ("of clutter (", "of structure (", "cupboard", "range bias -20 mm", "beam width 1.5 degrees"):
        assert words in said
    with open_log(path) as log:
        described = {key: json.loads(text) for key, text in log.metadata["prim"].items() if key != "version"}
        world = World.from_json(json.loads(log.attachment("world.json") or b""))
        truth = GroundTruth.read(log)
        ranges = np.concatenate([scan.ranges for _, scan in log.decoded(log.topics[SCAN_TOPIC])])
    options = {key: described["world"][key] for key in ("clutter", "room", "at_walls")}
    assert options == {"clutter": [2, 3], "room": ["L", "furniture"], "at_walls": 0.02}
    assert "touching" not in described["world"]
    faults = {"range_bias": -0.02, "beam_width": math.radians(1.5), "quantum": 0.01, "noise_growth": 0.01}
    assert described["lidar"]["faults"] == faults | {"dropouts": 0.2, "dropout_as": "max", "outliers": 0.01}
    assert 2 <= len(world.clutter) <= 3 and {"wall", "cupboard"} == {solid.name for solid in world.structure}
    assert truth is not None and truth.at(2**62).solids == world.solids
    assert np.mean(ranges == 5) == pytest.approx(0.2, abs=0.06)
    (tmp_path / "world.json").write_text(json.dumps(world.to_json()))
    assert prim_record(tmp_path / "b.mcap", "--world", tmp_path / "world.json", "--stops", 3, 3) == 0
    with open_log(tmp_path / "b.mcap") as log:
        assert World.from_json(json.loads(log.attachment("world.json") or b"")) == world


def test_faults_alone_change_nothing_else(tmp_path: Path) -> None:
    logs = [tmp_path / name for name in ("a.mcap", "b.mcap")]
    prim_record(logs[0], "--stops", 3, 3, "--rays", 90)
    prim_record(logs[1], "--stops", 3, 3, "--rays", 90, "--dropout", 0.5)
    read = []
    for path in logs:
        with open_log(path) as log:
            others = {t: [m.data for m in log.messages(t)] for t in sorted(log.topics) if t != SCAN_TOPIC}
            read.append((others, np.concatenate([scan.ranges for _, scan in log.decoded(log.topics[SCAN_TOPIC])])))
    assert read[0][0] == read[1][0]
    same = read[0][1] == read[1][1]
    assert same.mean() == pytest.approx(0.5, abs=0.1) and np.isposinf(read[1][1][~same]).all()


def test_a_world_is_read_from_a_file(tmp_path: Path) -> None:
    world = World((3.0, 2.0), (Primitive(Kind.SQUARE, 1.0, 0.5, 0.3, (0.2,)),)).with_walls()
    path = tmp_path / "world.json"
    path.write_text(json.dumps(world.to_json()))
    assert prim_record(tmp_path / "a.mcap", "--world", path, "--quiet") == 0
    with open_log(tmp_path / "a.mcap") as log:
        assert World.from_json(json.loads(log.attachment("world.json") or b"")) == world
    with pytest.raises(WorldError):
        record_session(tmp_path / "b.mcap", SessionOptions(world_file=tmp_path / "none.json"))


def test_command_line_options_reach_the_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.mcap"
    code = prim_record(
        *(path, "--seed", 1, "--kinds", "circle,ellipse", "--per-kind", 2, "--no-walls", "--rays", 90, "--fov", 180),
        *("--range-max", 3, "--noise", 0.05, "--gps-noise", 0.2, "--compass-noise", 5, "--stops", 2, 3, "--rate", 5),
        *("--size", 3, 4, "--motion", "warp"),
    )
    assert code == 0
    assert "noise 250 mm, 2 circles, 2 ellipses" in capsys.readouterr().out
    with open_log(path) as log:
        scans = [scan for _, scan in log.decoded(log.topics[SCAN_TOPIC])]
        described = log.metadata["prim"]
        world = World.from_json(json.loads(log.attachment("world.json") or b""))
    assert (world.size, world.walls) == ((3, 4), ())
    assert len(scans[0].ranges) == 90
    assert scans[0].angle_min == pytest.approx(-math.pi / 2)
    assert scans[1].stamp - scans[0].stamp == 200_000_000
    assert json.loads(described["lidar"])["noise_std"] == 0.25
    assert json.loads(described["compass"])["noise_std"] == pytest.approx(math.radians(5))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--noise", "0.05", "--noise-std", "0.05"], "give one of them"),
        (["--noise-std", "-1"], "must not be below 0"),
        (["--noise-std", "nan"], "must not be below 0"),
        (["--kinds", "pentagon"], "pentagon"),
        (["--per-kind", "3-1"], "from small to large"),
        (["--per-kind", "many"], "neither a number"),
        (["--per-kind", "40"], "do not fit"),
        (["--rays", "0"], "--rays"),
        (["--range-min", "6"], "not below"),
        (["--fov", "400"], "full turn"),
        (["--rate", "0"], "above 0"),
        (["--stops", "0", "5"], "above 0"),
        (["--motion", "fly"], "--motion"),
        (["--motion", "drive", "--stops", "3", "3"], "--stops does not go"),
        (["--movable"], "--movable does not go"),
        (["--odom-noise", "0.1", "1"], "--odom-noise does not go"),
        (["--motion", "drive", "--odom-noise", "-1", "1"], "--odom-noise"),
        (["--motion", "drive", "--speed", "0"], "--speed"),
        (["--motion", "drive", "--duration", "0"], "--duration"),
        (["--rate", "1e-9"], "--rate"),
        (["--range-max", "1e300"], "--range-max"),
        (["--nonsense"], "--nonsense"),
        (["--clutter", "3-1"], "--clutter 3-1"),
        (["--clutter", "some"], "--clutter 'some' is neither"),
        (["--clutter", "2000"], "--clutter is 2000"),
        (["--room", "attic"], "attic is nothing of a room, which is or has box,"),
        (["--room", "round,L"], "a room is one of box,round,corridor,L"),
        (["--room", "round", "--no-walls"], "--room does not go with --no-walls"),
        (["--room", "furniture", "--size", "0.1", "0.1"], "finds no place on"),
        (["--at-walls", "0", "--no-walls"], "--at-walls does not go with --no-walls"),
        (["--at-walls", "-1"], "--at-walls is -1"),
        (["--at-walls", "0.1", "--touching"], "exclude each other"),
        (["--world", "a.json", "--touching"], "--world excludes --touching"),
        (["--world", "a.json", "--clutter", "1"], "--world excludes --clutter"),
        (["--world", "a.json", "--no-walls"], "--world excludes --no-walls"),
        (["--range-bias", "nan"], "--range-bias is nan"),
        (["--range-bias", "-1e9"], "--range-bias is -1e+09"),
        (["--beam-width", "31"], "--beam-width is 31 degrees"),
        (["--beam-width", "-1"], "--beam-width"),
        (["--quantum", "-0.01"], "--quantum"),
        (["--dropout", "1.5"], "--dropout is 1.5"),
        (["--dropout", "0.1", "--dropout-as", "none"], "--dropout-as"),
        (["--dropout-as", "nan"], "--dropout-as needs --dropout"),
        (["--outliers", "2"], "--outliers is 2"),
        (["--noise-growth", "-1"], "--noise-growth"),
    ],
)
def test_invalid_options_are_refused_by_name(
    tmp_path: Path, arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert prim_record(tmp_path / "a.mcap", *arguments) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.startswith("prim-record: error: ")
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "options",
    [
        ["--size", "1e300", "2"], ["--size", "1e-320", "2"], ["--size", "nan", "2"], ["--rate", "1e300"],
        ["--range-max", "1e300"], ["--noise", "1e300"], ["--noise-std", "1e300"], ["--noise-std", "inf"],
        ["--gps-noise", "1e300"], ["--compass-noise", "1e300"], ["--rays", "1" + "0" * 30],
        ["--per-kind", "1" + "0" * 30], ["--stops", "1" + "0" * 30, "2"], ["--fov", "1e300"],
        ["--motion", "drive", "--duration", "1e300"], ["--motion", "drive", "--speed", "1e300"],
        ["--motion", "drive", "--speed", "1e-320"], ["--motion", "drive", "--odom-noise", "1e300", "1"],
        ["--motion", "drive", "--size", "1e5", "1e5", "--per-kind", "0"],
    ],
    ids=lambda options: " ".join(options)[:40],
)  # fmt: skip
def test_absurd_values_are_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str]
) -> None:
    assert console.run(app, "prim-record", [str(tmp_path / "a.mcap"), *options]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and "bug" not in err and len(err) < 300, err


def test_an_output_that_cannot_be_written_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert prim_record(tmp_path / "no" / "a.mcap") == 1
    assert prim_record(tmp_path) == 1
    assert capsys.readouterr().err.count("\n") == 2
