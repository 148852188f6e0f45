"""Rooms other than a box: round ones, corridors, inner walls with doorways, pilasters, furniture at walls.

A room is drawn as solid pieces of structure and as thin walls within the floor, whose edges keep their walls: a round
room is what pieces of wall in the floor's corners leave free. Elements are drawn one after the other, each again
until the robot can reach all that is left. Lengths are uniform in ranges, and never more than a share of the floor.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from shapely.affinity import affine_transform

from prim.arrays import FloatArray
from prim.errors import UsageError
from prim.shapes import TURN
from prim.world import Solid, Wall

Range = tuple[float, float]


@dataclass(frozen=True)
class RoomOptions:
    """What rooms are like; all set by hand.

    Attributes:
        round_share: Diameters of a round room, as shares of the floor's sides.
        corridor_share: Width of a corridor, as a share of the floor's shorter side.
        cut_share: Sides of the block that makes a room an L, as shares of the floor's.
        wall_thickness: Of inner walls that are not thin (m).
        thin_walls: How often inner walls are thin.
        tilted_walls: How often an inner wall is not parallel to an outer one.
        inner_share: Inner walls pass the middle of the floor, this share of its sides.
        tilt: By how much it then is turned at most (rad).
        door_width: Width of a doorway (m).
        framed_doors: How often a doorway in a thick wall has jambs that stick out.
        jamb_width: A jamb's width along the wall (m).
        jamb_depth: How far it sticks out of the wall (m).
        pilasters: Fewest and most pilasters.
        pilaster_width: A pilaster's width along the wall (m).
        pilaster_depth: How far it sticks out (m).
        cupboards: Fewest and most pieces of furniture.
        cupboard_width: A cupboard's width along the wall (m).
        cupboard_depth: Its depth (m).
        cupboard_gap: Its distance from the wall (m), every other time; else it touches the wall.
        max_share: An element's width is at most this share of the floor's shorter side.
        max_depth: An element's depth, and a wall's thickness, at most this share of it.
        robot_room: Free places are those that are this far (m) from all that stands there.
        free_share: What is free is at least this share of the floor.
        reachable: The largest connected part of the free places is at least this share of them.
        tries: An element is drawn this many times at most, or the floor is too small for it.
        grid: Coordinates of structure are whole multiples of this (m).
    """

    round_share: Range = (0.8, 1.0)
    corridor_share: Range = (0.3, 0.7)
    cut_share: Range = (0.3, 0.6)
    wall_thickness: Range = (0.05, 0.25)
    thin_walls: float = 0.25
    tilted_walls: float = 0.25
    inner_share: float = 0.6
    tilt: float = 0.3
    door_width: Range = (0.4, 1.0)
    framed_doors: float = 0.4
    jamb_width: Range = (0.03, 0.1)
    jamb_depth: Range = (0.01, 0.05)
    pilasters: tuple[int, int] = (2, 5)
    pilaster_width: Range = (0.1, 0.6)
    pilaster_depth: Range = (0.05, 0.35)
    cupboards: tuple[int, int] = (1, 4)
    cupboard_width: Range = (0.3, 1.2)
    cupboard_depth: Range = (0.3, 0.6)
    cupboard_gap: Range = (0.002, 0.03)
    max_share: float = 0.4
    max_depth: float = 0.2
    robot_room: float = 0.08
    free_share: float = 0.25
    reachable: float = 0.97
    tries: int = 100
    grid: float = 1e-6


DEFAULTS = RoomOptions()

CURVE_POINTS = 180
"""Vertices of a round room's wall: 0.3 mm off at a radius of 2 m."""

CURVED_STEPS = 20
"""Distances from a wall at which a cupboard is tried."""

BEHIND = 1.0
"""What stands at a wall is first drawn this far (m) into it, then cut: no slit is left at a curved wall."""


@dataclass(frozen=True)
class Room:
    """What a room has beside the walls along the floor's edges.

    Attributes:
        structure: Thick walls, pilasters and furniture.
        walls: Thin walls.
    """

    structure: tuple[Solid, ...] = ()
    walls: tuple[Wall, ...] = ()


def draw_room(
    rng: np.random.Generator, size: tuple[float, float], elements: Sequence[str], options: RoomOptions = DEFAULTS
) -> Room:
    """Draw a room.

    Args:
        rng: Draws it.
        size: The floor, along x and y (m).
        elements: What it has: keys of SHAPES and ELEMENTS, in any order.
        options: What it is like.

    Returns:
        The room.

    Raises:
        UsageError: An element finds no place on the floor.
    """
    site = _Site(rng, size, options)
    for name, build in {**SHAPES, **ELEMENTS}.items():
        if name in elements and not site.build(build):
            larger = " ".join(f"{math.ceil(max(2 * length, 2)):d}" for length in size)
            raise UsageError(
                f"--room {name} finds no place on {size[0]:g} x {size[1]:g} m: "
                f"give --arena {larger} or fewer elements"
            )
    return Room(tuple(site.structure), tuple(site.walls))


class _Site:
    """A room that is being built.

    Args:
        rng: Draws it.
        size: The floor (m).
        options: What it is like.
    """

    def __init__(self, rng: np.random.Generator, size: tuple[float, float], options: RoomOptions) -> None:
        self.rng = rng
        self.size = size
        self.options = options
        self.floor = shapely.box(-size[0] / 2, -size[1] / 2, size[0] / 2, size[1] / 2)
        self.free = self.floor
        self.structure: list[Solid] = []
        self.walls: list[Wall] = []

    def build(self, element: Callable[[_Site], None]) -> bool:
        """Draw an element until there is room left for the robot; return whether that was so."""
        before = self.free, list(self.structure), list(self.walls)
        for _ in range(self.options.tries):
            element(self)
            if len(self.structure) + len(self.walls) > len(before[1]) + len(before[2]) and self._is_roomy():
                return True
            self.free, self.structure, self.walls = before[0], list(before[1]), list(before[2])
        return False

    def uniform(self, limits: Range, most: float = math.inf) -> float:
        """Draw a length in a range whose ends are at most ``most``."""
        return float(self.rng.uniform(min(limits[0], most), min(limits[1], most)))

    def happens(self, chance: float) -> bool:
        """Draw whether something is so."""
        return bool(self.rng.random() < chance)

    @property
    def widest(self) -> float:
        """The largest width of an element (m)."""
        return self.options.max_share * min(self.size)

    @property
    def deepest(self) -> float:
        """The largest depth of an element (m)."""
        return self.options.max_depth * min(self.size)

    def fill(self, name: str, shape: shapely.Geometry) -> None:
        """Make what is free of a shape solid."""
        grid = self.options.grid
        pieces = shapely.get_parts(shapely.intersection(shape, self.free, grid_size=grid))
        for piece in pieces:
            if piece.geom_type == "Polygon" and piece.area > grid:
                self.structure.append(Solid.of(name, np.asarray(piece.exterior.coords)[:-1]))
        self.free = shapely.difference(self.free, shape, grid_size=grid)

    def has_room_for(self, shape: shapely.Geometry) -> bool:
        """Return whether a shape stands where it is free, and crosses no thin wall."""
        thin = (shapely.LineString([wall[:2], wall[2:]]) for wall in self.walls)
        return bool(self.free.contains(shape)) and not any(shape.intersects(wall) for wall in thin)

    def place_inside(self) -> FloatArray:
        """Draw a place that is free, in the inner part of the floor if there is one."""
        for _ in range(self.options.tries):
            place = np.array(
                [self.rng.uniform(-1, 1) * self.options.inner_share * length / 2 for length in self.size]
            )
            if self.free.contains(shapely.Point(place)):
                return place
        return np.asarray(shapely.get_coordinates(shapely.point_on_surface(self.free))[0])

    def place_at_wall(self) -> tuple[FloatArray, float]:
        """Draw a place on the boundary of what is free, and the wall's direction (rad), the room to its left."""
        ring = shapely.get_exterior_ring(max(shapely.get_parts(self.free), key=lambda part: part.area))
        corners = np.asarray(ring.coords if ring.is_ccw else ring.coords[::-1])
        steps = np.diff(corners, axis=0)
        lengths = np.hypot(*steps.T)
        edge = self.rng.choice(len(lengths), p=lengths / lengths.sum())
        place = corners[edge] + self.rng.random() * steps[edge]
        return place, math.atan2(steps[edge, 1], steps[edge, 0])

    def _is_roomy(self) -> bool:
        """Return whether the robot can reach nearly all free places, and there are enough of them."""
        options = self.options
        thin = [shapely.LineString([wall[:2], wall[2:]]).buffer(options.robot_room) for wall in self.walls]
        open_places = self.free.buffer(-options.robot_room).difference(shapely.union_all(thin))
        parts = [part.area for part in shapely.get_parts(open_places)]
        enough = self.free.area >= options.free_share * self.floor.area
        return enough and max(parts, default=0) > 0 and max(parts) >= options.reachable * sum(parts)


def _moved(shape: shapely.Geometry, place: FloatArray, direction: float) -> shapely.Geometry:
    """Turn a shape about the origin by ``direction`` (rad), and shift it to ``place``."""
    cos, sin = math.cos(direction), math.sin(direction)
    return affine_transform(shape, [cos, -sin, sin, cos, *place])


def _round_room(site: _Site) -> None:
    """Leave an ellipse free; every other time a circle."""
    axes = np.array([site.uniform(site.options.round_share) * length / 2 for length in site.size])
    if site.happens(0.5):
        axes[:] = axes.min()
    centre = [site.rng.uniform(-1, 1) * (length / 2 - axis) for length, axis in zip(site.size, axes, strict=True)]
    turn = np.linspace(0, TURN, CURVE_POINTS, endpoint=False)
    around = site.floor.difference(shapely.Polygon(np.column_stack((np.cos(turn), np.sin(turn))) * axes + centre))
    x0, y0, x1, y1 = site.floor.bounds
    for half in (shapely.box(x0, y0, centre[0], y1), shapely.box(centre[0], y0, x1, y1)):
        site.fill("wall", around.intersection(half))


def _corridor(site: _Site) -> None:
    """Leave a strip free, along the floor's longer side."""
    width, height = site.size
    along_x = width > height or (width == height and site.happens(0.5))
    across = min(width, height)
    strip = site.uniform(site.options.corridor_share) * across
    middle = site.rng.uniform(-1, 1) * (across - strip) / 2
    x0, y0, x1, y1 = site.floor.bounds
    low, high = middle - strip / 2, middle + strip / 2
    sides = (x0, y0, x1, low, x0, high, x1, y1) if along_x else (x0, y0, low, y1, high, y0, x1, y1)
    for side in (sides[:4], sides[4:]):
        site.fill("wall", shapely.box(*side))


def _l_room(site: _Site) -> None:
    """Fill a corner of the floor with a block."""
    corner = [site.rng.choice((-1.0, 1.0)) * length / 2 for length in site.size]
    sides = [site.uniform(site.options.cut_share) * length for length in site.size]
    inner = [place - math.copysign(side, place) for place, side in zip(corner, sides, strict=True)]
    site.fill("wall", shapely.box(*map(min, corner, inner), *map(max, corner, inner)))


def _doorways(site: _Site) -> None:
    """Put a wall with doorways across the floor; every third time another one that begins at it."""
    options, rng = site.options, site.rng
    reach = 2 * max(site.size)
    direction = float(rng.choice((0.0, TURN / 4)))
    if site.happens(options.tilted_walls):
        direction += rng.uniform(-options.tilt, options.tilt)
    along = np.array([math.cos(direction), math.sin(direction)])
    through = site.place_inside()
    _wall(site, through - reach * along, through + reach * along)
    if site.happens(1 / 3):
        start = through + rng.uniform(-0.25, 0.25) * min(site.size) * along
        across = float(rng.choice((-1.0, 1.0))) * np.array([-along[1], along[0]])
        _wall(site, start, start + reach * across)


def _wall(site: _Site, start: FloatArray, end: FloatArray) -> None:
    """Put a wall from ``start`` to ``end`` where it is free, with one or two doorways in its longest stretch."""
    options = site.options
    parts = shapely.get_parts(site.free.intersection(shapely.LineString([start, end])))
    stretches = [part for part in parts if part.length > options.grid]
    if not stretches:
        return
    longest = max(stretches, key=lambda part: part.length)
    direction = math.atan2(*(end - start)[::-1])
    thickness = 0.0 if site.happens(options.thin_walls) else site.uniform(options.wall_thickness, site.deepest)
    doors, jambs = [], []
    for _ in range(site.rng.integers(1, 3)):
        half = site.uniform(options.door_width, site.widest) / 2
        place = np.asarray(longest.interpolate(site.rng.uniform(0.2, 0.8), normalized=True).coords[0])
        doors.append(_moved(shapely.box(-half, -1, half, 1), place, direction))
        if thickness and site.happens(options.framed_doors):
            outer, deep = half + site.uniform(options.jamb_width), thickness / 2 + site.uniform(options.jamb_depth)
            jambs.append(_moved(shapely.box(-outer, -deep, outer, deep), place, direction))
    if thickness:
        strip = shapely.LineString([start, end]).buffer(thickness / 2, cap_style="flat")
        site.fill("wall", shapely.union_all([strip, *jambs]).difference(shapely.union_all(doors)))
        return
    for part in shapely.get_parts(shapely.MultiLineString(stretches).difference(shapely.union_all(doors))):
        if part.length > options.grid:
            (x0, y0), (x1, y1) = part.coords
            site.walls.append((x0, y0, x1, y1))


def _pilasters(site: _Site) -> None:
    """Let boxes, wedges and half rounds stick out of the walls, and blocks out of the corners."""
    options = site.options
    for _ in range(site.rng.integers(*options.pilasters, endpoint=True)):
        if site.free.is_empty:
            return
        place, direction = site.place_at_wall()
        half = site.uniform(options.pilaster_width, site.widest) / 2
        depth = site.uniform(options.pilaster_depth, site.deepest)
        shape = str(site.rng.choice(("box", "box", "wedge", "half round", "corner")))
        foot = shapely.box(-half, -BEHIND, half, 0)
        if shape == "corner":
            corners = shapely.get_coordinates(site.free)
            place = corners[np.hypot(*(corners - place).T).argmin()]
            front = shapely.box(-half, -half, half, half)
            foot = front
        elif shape == "wedge":
            front = shapely.Polygon([(-half, 0), (half, 0), (site.rng.uniform(-half, half), depth)])
        elif shape == "half round":
            front = affine_transform(shapely.Point(0, 0).buffer(1.0, quad_segs=24), [half, 0, 0, depth, 0, 0])
        else:
            front = shapely.box(-half, 0, half, depth)
        site.fill("pilaster", _moved(shapely.union(foot, front), place, direction))


def _furniture(site: _Site) -> None:
    """Put cupboards along the walls, at them or nearly."""
    options = site.options
    for _ in range(site.rng.integers(*options.cupboards, endpoint=True)):
        half = site.uniform(options.cupboard_width, site.widest) / 2
        depth = site.uniform(options.cupboard_depth, site.deepest)
        gap = site.uniform(options.cupboard_gap) if site.happens(0.5) else 0.0
        for _ in range(options.tries):
            place, direction = site.place_at_wall()
            gaps = (gap, *np.linspace(gap, site.deepest, CURVED_STEPS))  # at a curved wall only its corners touch
            boxes = [_moved(shapely.box(-half, gap, half, gap + depth), place, direction) for gap in gaps]
            fits = [box for box in boxes if site.has_room_for(box.buffer(-options.grid))]
            if fits:
                site.fill("cupboard", fits[0])
                break


SHAPES: dict[str, Callable[[_Site], None]] = {
    "round": _round_room,
    "corridor": _corridor,
    "L": _l_room,
}
"""The shapes that a room may have, one of them; else it is a box."""

ELEMENTS: dict[str, Callable[[_Site], None]] = {
    "doorways": _doorways,
    "pilasters": _pilasters,
    "furniture": _furniture,
}
"""What it may have in any of these shapes."""
