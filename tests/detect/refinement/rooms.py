"""Small rooms with primitives, and scans of them from all sides, made without the recorder."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from mapping.grid import OccupancyGrid
from mapping.mapper import make_mapper
from prim.scan import Scan
from prim.se2 import Pose2D
from prim.shapes import Kind, Primitive
from prim.world import World

SIZES = {
    Kind.SQUARE: (0.2,),
    Kind.RECTANGLE: (0.28, 0.14),
    Kind.CIRCLE: (0.12,),
    Kind.TRIANGLE: (0.25, 0.18),
    Kind.ELLIPSE: (0.15, 0.08),
}

WALLS = ((-1.0, -1.0, 1.0, -1.0), (1.0, -1.0, 1.0, 1.0), (1.0, 1.0, -1.0, 1.0), (-1.0, 1.0, -1.0, -1.0))


def shape(kind: Kind, x: float = 0.0, y: float = 0.0, theta: float = 0.4) -> Primitive:
    return Primitive(kind, x, y, theta if kind.has_angle else None, SIZES[kind]).canonical()


def room(*primitives: Primitive) -> World:
    return World((2.0, 2.0), primitives, WALLS)


def scans(world: World, noise: float, rays: int = 240, stops: int = 8, seed: int = 0) -> list[tuple[Scan, Pose2D]]:
    """Scans from ``stops`` x ``stops`` places that are in no primitive."""
    rng = np.random.default_rng(seed)
    made = []
    places = np.linspace(-0.85, 0.85, stops)
    for x in places.tolist():
        for y in places.tolist():
            if any(math.hypot(x - one.x, y - one.y) < 0.25 for one in world.primitives):
                continue
            pose = Pose2D(x, y, float(rng.uniform(-3, 3)))
            scan = Scan(len(made) + 1, "laser", -math.pi, 2 * math.pi / rays, 0.032, 5.0, np.zeros(rays, np.float32))
            cos, sin = math.cos(pose.theta), math.sin(pose.theta)
            exact = world.cast((x, y), scan.directions @ np.array([[cos, sin], [-sin, cos]]))
            ranges = exact + rng.normal(0, noise, rays) if noise else exact
            ranges = np.where(ranges < scan.range_min, -np.inf, np.where(ranges >= scan.range_max, np.inf, ranges))
            made.append((Scan(scan.stamp, "laser", scan.angle_min, scan.angle_increment, 0.032, 5.0,
                              ranges.astype(np.float32)), pose))  # fmt: skip
    return made


def with_dropouts(
    of: list[tuple[Scan, Pose2D]], share: float, missing: float = math.inf, seed: int = 0
) -> list[tuple[Scan, Pose2D]]:
    """The scans with a share of the returns missing."""
    rng = np.random.default_rng(seed)
    made = []
    for scan, pose in of:
        lost = np.isfinite(scan.ranges) & (rng.random(len(scan.ranges)) < share)
        made.append((replace(scan, ranges=np.where(lost, np.float32(missing), scan.ranges)), pose))
    return made


def mapped(of: list[tuple[Scan, Pose2D]], mapper: str = "forward") -> OccupancyGrid:
    made = make_mapper(mapper, 0.01, (-1.1, -1.1, 1.1, 1.1))
    for scan, pose in of:
        made.accumulate(scan, pose)
    return made.finish()
