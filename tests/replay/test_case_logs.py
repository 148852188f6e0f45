"""Small logs that were built after public bug reports, by others: each ends as its description asks."""

import math
from pathlib import Path
from typing import Any

import pytest

import prim
from tests.conftest import DATA

CASES = DATA.parent / "cases" / "logs"


def case(name: str) -> Path:
    found = [path for path in CASES.glob(f"{name}*") if path.suffix != ".txt"]
    if not found:
        pytest.skip(f"the case {name} is not here (looked in {CASES})")
    return found[0]


def replayed(name: str, **options: Any) -> prim.Result:
    return prim.replay(case(name), mapper="forward", **options)


@pytest.mark.parametrize(
    ("name", "note"),
    [
        ("filezstd", None),
        ("foxglove_protobuf", None),
        ("gps_gentle", "together show the robot's way no better than /odom alone, which is used"),
        ("inc0", "angle_increment contradicts angle_min and angle_max in 120 scans"),
        ("msgzstd", None),
        ("multiecho", None),
        ("pointcloud2", None),
        ("split", None),
        ("stamp0", "the stamps of /scan are 0"),
        ("sweep_endstamp", "the stamp is the last beam's"),
        ("two_lidars", "2 scanners of one robot are mapped together"),
        ("twoclocks", "/scan is stamped 1699999995.000 s behind the poses"),
    ],
)
def test_the_room_is_found_in_every_form(name: str, note: str | None) -> None:
    """All are of one room of 4 x 3 m with a square and a circle in it."""
    result = replayed(name)
    circle, square = sorted(result.primitives, key=lambda primitive: str(primitive.kind))
    assert (str(circle.kind), str(square.kind)) == ("circle", "square")
    assert (square.x, square.y, square.size["side"]) == pytest.approx((1.1, 1.05, 0.25), abs=0.02)
    assert (circle.x, circle.y, circle.size["radius"]) == pytest.approx((2.9, 1.2, 0.15), abs=0.02)
    assert (note is None and not result.notes) or any(note in line for line in result.notes if note)


def test_scans_alone_show_the_room() -> None:
    """Where it lies on the map nobody knows; how far its things stand from each other the scans tell."""
    result = replayed("scan_only")
    circle, square = sorted(result.primitives, key=lambda primitive: str(primitive.kind))
    assert (str(circle.kind), str(square.kind)) == ("circle", "square")
    assert (square.size["side"], circle.size["radius"]) == pytest.approx((0.25, 0.15), abs=0.01)
    assert math.hypot(circle.x - square.x, circle.y - square.y) == pytest.approx(math.hypot(1.8, 0.15), abs=0.02)
    assert result.poses.source == "scans" and any("found by the scans alone" in note for note in result.notes)


def test_a_split_bag_is_one_log() -> None:
    assert replayed("split").report["log"]["scans"] == 120


def test_a_mount_that_is_not_in_the_log_is_noted_and_can_be_given() -> None:
    assert any("no transform from base_link to laser" in note for note in replayed("nostatic_tfonly").notes)
    result = replayed("nostatic_tfonly", laser_offset=(0.1, 0.02, 0.2))
    assert sorted(str(primitive.kind) for primitive in result.primitives) == ["circle", "square"]


def test_messages_of_ros1_in_mcap_are_read() -> None:
    result = replayed("ros1_in_mcap")
    kinds = [str(primitive.kind) for primitive in result.primitives]
    assert len(kinds) == 4 and kinds.count("circle") >= 3 and {*kinds} <= {"circle", "ellipse"}  # its poses are off
    sizes = [size for primitive in result.primitives for size in primitive.size.values()]
    assert sizes == pytest.approx([0.15] * len(sizes), abs=0.005)


def test_scans_of_two_scanners_are_matched_as_those_of_one_robot() -> None:
    result = replayed("two_lidars", match_scans=True)
    kinds = [str(primitive.kind) for primitive in result.primitives]
    boxes, rounds = ("square", "rectangle"), ("circle", "ellipse")  # matched poses are off by millimetres
    assert sorted(kind in boxes for kind in kinds) == [False, True] and {*kinds} <= {*boxes, *rounds}
    for primitive, kind in zip(result.primitives, kinds, strict=True):
        sizes = [*primitive.size.values()]
        expected = 0.25 if kind in boxes else 0.15
        assert sizes == pytest.approx([expected] * len(sizes), abs=0.015)
    assert result.grid.frame.rows < 320
