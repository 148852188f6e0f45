"""How the robot moves: warped from place to place by a supervisor, or driving by its wheels."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from prim.errors import UsageError
from prim.se2 import Pose2D, wrap_angle
from prim.world import World
from recorder.simulator import AXLE, ROBOT_RADIUS, Simulator


@dataclass(frozen=True)
class Step:
    """One moment of a session: the robot's true pose, the world as it is, and the way since the last (m)."""

    pose: Pose2D
    world: World
    travelled: float = 0.0


def warp(simulator: Simulator, rng: np.random.Generator, stops: tuple[int, int] = (10, 10)) -> Iterator[Step]:
    """The paper's supervisor: the robot is put on a regular grid of places (cols, rows), at random headings.

    Places where it would stand inside a primitive or touch one are passed over.
    """
    x0, y0, x1, y1 = simulator.world.bounds
    cols, rows = stops
    for row in range(rows):
        for col in range(cols):
            x = x0 + (col + 0.5) * (x1 - x0) / cols
            y = y0 + (row + 0.5) * (y1 - y0) / rows
            pose = Pose2D(x, y, rng.uniform(-math.pi, math.pi))
            if simulator.warp(pose):
                yield Step(pose, simulator.world)


def drive(simulator: Simulator, rng: np.random.Generator, period: float, steps: int, speed: float) -> Iterator[Step]:
    """The robot explores: it drives to a place where it has not been, along a way that keeps off obstacles, again
    and again. Primitives that can be pushed are no obstacles to it.

    ``period`` (s) lies between steps, ``speed`` (m/s) is the largest of a wheel's rim. Raises UsageError where the
    robot has no room to stand.
    """
    explorer = Explorer(simulator, rng)
    pose = explorer.start()
    for _ in range(steps):
        before = pose
        yield Step(pose, simulator.moved_world(), explorer.travelled)
        substeps = max(1, math.ceil(period / Explorer.REACTION))
        explorer.travelled = 0.0
        for _ in range(substeps):
            simulator.drive(*explorer.wheels(simulator.pose, speed), period / substeps)
            now = simulator.pose
            turned = abs(wrap_angle(now.theta - before.theta))
            explorer.travelled += math.hypot(now.x - before.x, now.y - before.y) + turned * AXLE / 2
            before = now
        pose = before


class Explorer:
    """Chooses where to drive, and the wheels' speeds that lead there."""

    CELL = 0.05
    MARGIN = 0.03
    """The robot's rim keeps this far (m) from obstacles."""
    NEAR = 0.06
    """A waypoint is reached at this distance (m)."""
    SEEN = 0.25
    """Places within this distance (m) of where the robot was count as explored."""
    REACTION = 0.05
    """Seconds between two decisions."""
    PATIENCE = 40
    """Decisions without headway after which the robot backs off and goes elsewhere."""

    def __init__(self, simulator: Simulator, rng: np.random.Generator) -> None:
        self._simulator = simulator
        self._rng = rng
        self._way: deque[tuple[float, float]] = deque()
        self._free = self._free_cells()
        self._unseen: set[tuple[int, int]] = set()
        self._best = math.inf
        self._stuck = 0
        self.travelled = 0.0

    def start(self) -> Pose2D:
        """Puts the robot somewhere, on the largest free area."""
        self._free = _largest_area(self._free)
        if not self._free:
            raise UsageError("the robot finds no room to drive: give a larger --size or fewer primitives")
        cells = sorted(self._free)
        for index in self._rng.permutation(len(cells)):
            pose = Pose2D(*self._centre(cells[index]), self._rng.uniform(-math.pi, math.pi))
            if self._simulator.warp(pose):
                return pose
        raise UsageError("the robot finds no room to stand: every place is taken by a primitive")

    def wheels(self, pose: Pose2D, speed: float) -> tuple[float, float]:
        """Rim speeds (m/s) of the left and the right wheel, from where the robot is now."""
        self._unseen -= self._around(pose)
        if self._stuck > self.PATIENCE:
            return self._back_off(speed)
        while self._way and math.hypot(self._way[0][0] - pose.x, self._way[0][1] - pose.y) < self.NEAR:
            self._way.popleft()
            self._best = math.inf
        if not self._way:
            self._plan(pose)
        x, y = self._way[0] if self._way else (pose.x, pose.y)
        self._watch_headway(math.hypot(x - pose.x, y - pose.y))
        error = wrap_angle(math.atan2(y - pose.y, x - pose.x) - pose.theta)
        turn = min(max(4.0 * error, -6.0), 6.0) * AXLE / 2
        ahead = speed * max(0.0, math.cos(error)) ** 2
        largest = max(abs(ahead - turn), abs(ahead + turn), speed)
        return (ahead - turn) * speed / largest, (ahead + turn) * speed / largest

    def _watch_headway(self, distance: float) -> None:
        if distance < self._best - 1e-3:
            self._best, self._stuck = distance, 0
        else:
            self._stuck += 1

    def _back_off(self, speed: float) -> tuple[float, float]:
        self._stuck += 1
        if self._stuck > self.PATIENCE + 15:
            self._stuck, self._best = 0, math.inf
            self._way.clear()
        return -speed, -0.6 * speed

    def _plan(self, pose: Pose2D) -> None:
        """The shortest way over free cells to a random one that has not been seen."""
        here = min(self._free, key=lambda cell: math.dist(self._centre(cell), (pose.x, pose.y)))
        if not self._unseen:
            self._unseen = self._free - self._around(pose)
        goals = sorted(self._unseen or self._free)
        goal = goals[self._rng.integers(len(goals))]
        self._way = deque(self._centre(cell) for cell in _shortest(self._free, here, goal))
        self._best, self._stuck = math.inf, 0

    def _around(self, pose: Pose2D) -> set[tuple[int, int]]:
        reach = round(self.SEEN / self.CELL)
        row, col = math.floor(pose.y / self.CELL), math.floor(pose.x / self.CELL)
        spread = range(-reach, reach + 1)
        return {(row + r, col + c) for r in spread for c in spread if r * r + c * c <= reach * reach}

    def _free_cells(self) -> set[tuple[int, int]]:
        """Cells (row, col) of the floor where the robot keeps off all that stands still."""
        x0, y0, x1, y1 = self._simulator.world.bounds
        rows = range(math.floor(y0 / self.CELL), math.ceil(y1 / self.CELL))
        cols = range(math.floor(x0 / self.CELL), math.ceil(x1 / self.CELL))
        return {(row, col) for row in rows for col in cols if self._has_room(*self._centre((row, col)))}

    def _has_room(self, x: float, y: float) -> bool:
        x0, y0, x1, y1 = self._simulator.world.bounds
        room = ROBOT_RADIUS + self.MARGIN
        on_floor = x0 + room <= x <= x1 - room and y0 + room <= y <= y1 - room
        return on_floor and self._simulator.clearance(x, y, room) >= room

    def _centre(self, cell: tuple[int, int]) -> tuple[float, float]:
        return (cell[1] + 0.5) * self.CELL, (cell[0] + 0.5) * self.CELL


def _neighbours(cell: tuple[int, int]) -> list[tuple[int, int]]:
    row, col = cell
    return [(row + 1, col), (row - 1, col), (row, col + 1), (row, col - 1)]


def _largest_area(cells: set[tuple[int, int]]) -> set[tuple[int, int]]:
    """The largest connected part of the cells."""
    left, largest = set(cells), set[tuple[int, int]]()
    while left:
        area = set(_reach(left, min(left)))
        left -= area
        largest = max(largest, area, key=len)
    return largest


def _reach(cells: set[tuple[int, int]], start: tuple[int, int]) -> dict[tuple[int, int], tuple[int, int]]:
    """All cells that can be reached from ``start``, each with the one before it on a shortest way."""
    came_from = {start: start}
    queue = deque([start])
    while queue:
        cell = queue.popleft()
        for other in _neighbours(cell):
            if other in cells and other not in came_from:
                came_from[other] = cell
                queue.append(other)
    return came_from


def _shortest(cells: set[tuple[int, int]], start: tuple[int, int], goal: tuple[int, int]) -> list[tuple[int, int]]:
    """The corners of a shortest way from ``start`` to ``goal`` (none if there is no way)."""
    came_from = _reach(cells, start)
    if goal not in came_from:
        return []
    way = [goal]
    while way[-1] != start:
        way.append(came_from[way[-1]])
    return way[-2::-1] or [goal]
