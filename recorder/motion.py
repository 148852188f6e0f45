"""How the robot moves: the poses it takes its scans from."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from prim.frames import Pose2D
from prim.world import World
from recorder.simulator import Simulator


def warp_poses(
    world: World, simulator: Simulator, rng: np.random.Generator, stops: tuple[int, int] = (10, 10)
) -> Iterator[Pose2D]:
    """The paper's supervisor: the robot is put on a regular grid of places (cols, rows), at random headings.

    Places where it would stand inside a primitive or touch one are passed over.
    """
    x0, y0, x1, y1 = world.bounds
    cols, rows = stops
    for row in range(rows):
        for col in range(cols):
            x = x0 + (col + 0.5) * (x1 - x0) / cols
            y = y0 + (row + 0.5) * (y1 - y0) / rows
            pose = Pose2D(x, y, rng.uniform(-math.pi, math.pi))
            if simulator.warp(pose):
                yield pose
