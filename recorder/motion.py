"""How the robot moves: warped (teleported) from place to place by a supervisor, or driving by its wheels."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from prim.errors import UsageError
from prim.se2 import Pose2D, wrap_angle
from prim.world import World
from recorder.simulator import Simulator
from recorder.world import WorldOptions

Cell = tuple[int, int]
"""Row and column of a cell of the explorer's grid."""


@dataclass(frozen=True)
class Step:
    """One moment of a session.

    Attributes:
        pose: The robot's true pose.
        world: The world as it is then.
        travelled: The true path since the step before plus |turn| x track width / 2 (m): how far the outer wheel
            rolls if it does not slip. The odometry's noise grows with it.
    """

    pose: Pose2D
    world: World
    travelled: float = 0.0


@dataclass(frozen=True)
class ExplorerOptions:
    """How a driving robot explores; all set by hand.

    Attributes:
        cell: Side of the cells of the grid in which paths are planned (m).
        margin: Clearance between the robot's rim and obstacles (m).
        waypoint_tolerance: A waypoint is reached at this distance (m).
        explored_radius: Places within this distance of where the robot was count as explored (m).
        decision_period: Time between two decisions (s).
        heading_gain: Turn rate for a heading error (1/s).
        max_turn_rate: Largest turn rate (rad/s).
        max_cells: The grid of a larger floor would not fit into memory.
        progress: Coming nearer to the waypoint by less than this is no progress (m).
        patience: Decisions without progress after which the robot backs off and plans anew.
        back_off_decisions: Decisions for which it backs off.
        back_off_ratio: The right wheel's speed over the left one's while it backs off.
    """

    cell: float = 0.05
    margin: float = 0.03
    waypoint_tolerance: float = 0.06
    explored_radius: float = 0.25
    decision_period: float = 0.05
    heading_gain: float = 4.0
    max_turn_rate: float = 6.0
    max_cells: int = 4_000_000
    progress: float = 1e-3
    patience: int = 40
    back_off_decisions: int = 15
    back_off_ratio: float = 0.6


DEFAULTS = ExplorerOptions()
USUAL_FLOOR = WorldOptions().size
"""The floor (m) of a session by default, which leaves the robot room."""


def warp(simulator: Simulator, rng: np.random.Generator, stops: tuple[int, int] = (10, 10)) -> Iterator[Step]:
    """Teleport the robot over a regular grid of places, at random headings (the paper's supervisor «warps» it).

    Args:
        simulator: The world and the robot.
        rng: Draws the headings.
        stops: Columns and rows of the grid over the floor.

    Yields:
        A step for each place, row by row; places where the robot would touch a primitive are left out.
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


def drive(
    simulator: Simulator,
    rng: np.random.Generator,
    period: float,
    steps: int,
    speed: float,
    options: ExplorerOptions = DEFAULTS,
) -> Iterator[Step]:
    """Let the robot explore: time and again it drives to a random place where it has not been, around obstacles.

    Primitives that can be pushed are no obstacles to it.

    Args:
        simulator: The world and the robot.
        rng: Draws the start and the goals.
        period: Time between steps (s).
        steps: The number of steps.
        speed: Largest rim speed of a wheel (m/s).
        options: How it explores.

    Yields:
        The steps; the first one at the start.

    Raises:
        UsageError: The robot has no room to stand, or the floor is too large.
    """
    explorer = Explorer(simulator, rng, options)
    pose = explorer.start()
    travelled = 0.0
    substeps = max(1, math.ceil(period / options.decision_period))
    for _ in range(steps):
        yield Step(pose, simulator.current_world(), travelled)
        travelled = 0.0
        for _ in range(substeps):
            before = pose
            simulator.drive(*explorer.wheel_speeds(simulator.pose, speed), period / substeps)
            pose = simulator.pose
            turned = abs(wrap_angle(pose.theta - before.theta))
            travelled += math.hypot(pose.x - before.x, pose.y - before.y) + turned * simulator.options.track_width / 2


class Explorer:
    """Chooses where to drive, and the wheels' speeds that lead there.

    It plans on a grid of the floor: to a random cell that the robot has not come near to, by a shortest path over
    cells where the robot keeps clear of all that cannot be moved.

    Args:
        simulator: The world and the robot.
        rng: Draws the start and the goals.
        options: How it explores.
    """

    def __init__(self, simulator: Simulator, rng: np.random.Generator, options: ExplorerOptions = DEFAULTS) -> None:
        self._simulator = simulator
        self._rng = rng
        self._options = options
        self._path: deque[tuple[float, float]] = deque()
        self._free = self._free_cells()
        self._unexplored: set[Cell] = set()
        self._nearest = math.inf
        self._stuck = 0

    def start(self) -> Pose2D:
        """Put the robot at a random place of the largest connected free area, and return its pose.

        Raises:
            UsageError: There is no such place.
        """
        self._free = _largest_component(self._free)
        if not self._free:
            x0, y0, x1, y1 = self._simulator.world.bounds
            larger = " ".join(f"{max(2 * side, max(USUAL_FLOOR)):g}" for side in (x1 - x0, y1 - y0))
            raise UsageError(
                f"the robot finds no room to drive: give --arena {larger} or fewer primitives, or a roomier --world"
            )
        cells = sorted(self._free)
        for index in self._rng.permutation(len(cells)):
            pose = Pose2D(*self._centre(cells[index]), self._rng.uniform(-math.pi, math.pi))
            if self._simulator.warp(pose):
                return pose
        raise UsageError("the robot finds no room to stand: every place is taken by a primitive")

    def wheel_speeds(self, pose: Pose2D, speed: float) -> tuple[float, float]:
        """Decide on the wheels' speeds: turn towards the next waypoint, and go ahead as far as it lies ahead.

        Args:
            pose: Where the robot is.
            speed: Largest rim speed (m/s).

        Returns:
            Rim speeds (m/s) of the left and the right wheel.
        """
        options = self._options
        self._unexplored -= self._around(pose)
        if self._stuck > options.patience:
            return self._back_off(speed)
        while self._path and math.hypot(self._path[0][0] - pose.x, self._path[0][1] - pose.y) < (
            options.waypoint_tolerance
        ):
            self._path.popleft()
            self._nearest = math.inf
        if not self._path:
            self._plan(pose)
        x, y = self._path[0] if self._path else (pose.x, pose.y)
        self._watch_progress(math.hypot(x - pose.x, y - pose.y))
        error = wrap_angle(math.atan2(y - pose.y, x - pose.x) - pose.theta)
        rate = min(max(options.heading_gain * error, -options.max_turn_rate), options.max_turn_rate)
        turn = rate * self._simulator.options.track_width / 2
        ahead = speed * max(0.0, math.cos(error)) ** 2
        largest = max(abs(ahead - turn), abs(ahead + turn), speed)
        return (ahead - turn) * speed / largest, (ahead + turn) * speed / largest

    def _watch_progress(self, distance: float) -> None:
        if distance < self._nearest - self._options.progress:
            self._nearest, self._stuck = distance, 0
        else:
            self._stuck += 1

    def _back_off(self, speed: float) -> tuple[float, float]:
        self._stuck += 1
        if self._stuck > self._options.patience + self._options.back_off_decisions:
            self._stuck, self._nearest = 0, math.inf
            self._path.clear()
        return -speed, -self._options.back_off_ratio * speed

    def _plan(self, pose: Pose2D) -> None:
        """Find a shortest path over free cells to a random unexplored one; to any free cell once all are explored."""
        here = min(self._free, key=lambda cell: math.dist(self._centre(cell), (pose.x, pose.y)))
        if not self._unexplored:
            self._unexplored = self._free - self._around(pose)
        goals = sorted(self._unexplored or self._free)
        goal = goals[self._rng.integers(len(goals))]
        self._path = deque(self._centre(cell) for cell in _shortest_path(self._free, here, goal))
        self._nearest, self._stuck = math.inf, 0

    def _around(self, pose: Pose2D) -> set[Cell]:
        """Return the cells that count as explored from ``pose``."""
        cell = self._options.cell
        reach = round(self._options.explored_radius / cell)
        row, col = math.floor(pose.y / cell), math.floor(pose.x / cell)
        spread = range(-reach, reach + 1)
        return {(row + r, col + c) for r in spread for c in spread if r * r + c * c <= reach * reach}

    def _free_cells(self) -> set[Cell]:
        """Return the cells of the floor where the robot keeps clear of all that cannot be moved."""
        x0, y0, x1, y1 = self._simulator.world.bounds
        cell = self._options.cell
        rows = range(math.floor(y0 / cell), math.ceil(y1 / cell))
        cols = range(math.floor(x0 / cell), math.ceil(x1 / cell))
        if len(rows) * len(cols) > self._options.max_cells:
            longest = (math.isqrt(self._options.max_cells) - 2) * cell  # two cells reach beyond the edges
            smaller = " ".join(f"{min(side, longest):g}" for side in (x1 - x0, y1 - y0))
            raise UsageError(
                f"a floor of {x1 - x0:g} x {y1 - y0:g} m is too large to drive on: give --arena {smaller} or less, "
                "or a smaller --world"
            )
        return {(row, col) for row in rows for col in cols if self._has_room(*self._centre((row, col)))}

    def _has_room(self, x: float, y: float) -> bool:
        x0, y0, x1, y1 = self._simulator.world.bounds
        room = self._simulator.options.robot_radius + self._options.margin
        on_floor = x0 + room <= x <= x1 - room and y0 + room <= y <= y1 - room
        return on_floor and self._simulator.clearance(x, y, room) >= room

    def _centre(self, cell: Cell) -> tuple[float, float]:
        return (cell[1] + 0.5) * self._options.cell, (cell[0] + 0.5) * self._options.cell


def _neighbours(cell: Cell) -> list[Cell]:
    row, col = cell
    return [(row + 1, col), (row - 1, col), (row, col + 1), (row, col - 1)]


def _largest_component(cells: set[Cell]) -> set[Cell]:
    """Return the largest 4-connected component of the cells."""
    left, largest = set(cells), set[Cell]()
    while left:
        component = set(_predecessors(left, min(left)))
        left -= component
        largest = max(largest, component, key=len)
    return largest


def _predecessors(cells: set[Cell], start: Cell) -> dict[Cell, Cell]:
    """Search breadth-first: all cells that can be reached from ``start``, each with the one before it on the path."""
    predecessors = {start: start}
    queue = deque([start])
    while queue:
        cell = queue.popleft()
        for other in _neighbours(cell):
            if other in cells and other not in predecessors:
                predecessors[other] = cell
                queue.append(other)
    return predecessors


def _shortest_path(cells: set[Cell], start: Cell, goal: Cell) -> list[Cell]:
    """Return the cells of a shortest path behind ``start`` up to ``goal``; none where there is no path."""
    predecessors = _predecessors(cells, start)
    if goal not in predecessors:
        return []
    path = [goal]
    while path[-1] != start:
        path.append(predecessors[path[-1]])
    return path[-2::-1] or [goal]
