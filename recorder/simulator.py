"""The world as a pymunk space seen from above, with an e-puck-like differential-drive robot in it.

Gravity only presses on the floor. A wheel's tyre pulls the robot towards the wheel's own speed along its rolling
direction and keeps it from slipping sideways, both up to the tyre's Coulomb friction; contacts with walls and
primitives are pymunk's. A movable primitive slides with Coulomb friction between it and the floor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pymunk
import shapely

from prim.se2 import Pose2D
from prim.shapes import Primitive
from prim.world import World


@dataclass(frozen=True)
class SimulatorOptions:
    """The robot's dimensions, the physics, and how finely it is simulated.

    Attributes:
        robot_radius: Radius of the robot's body (m); the e-puck's, by its data sheet.
        track_width: Distance between the wheels (m); the e-puck's, by its data sheet.
        robot_mass: Kg; about the e-puck's.
        primitive_density: Mass of movable primitives (kg/m^2); hollow boxes that the robot can push, set by hand.
        gravity: m/s^2; standard gravity.
        tyre_friction: Coulomb coefficient between tyres and floor; rubber on wood, set by hand.
        floor_friction: Coulomb coefficient between primitives and floor, set by hand.
        contact_friction: Coulomb coefficient of contacts among robot, primitives and walls, set by hand.
        overlap: How far bodies in contact may overlap (m); pymunk's own value is made for pixels, and lets the robot
            sink into walls by centimetres.
        overlap_after_a_second: The share of a larger overlap that remains after a second; see ``overlap``.
        step: Time step of the simulation (s), set by hand.
        iterations: Iterations of pymunk's contact solver in a step (its own default is 10), set by hand.
        min_shift: A primitive that was shifted by less has not moved (m), set by hand.
        min_turn: A primitive that was turned by less has not moved (rad), set by hand.
        outline_points: Vertices that stand for a curved outline that can turn, set by hand.
    """

    robot_radius: float = 0.035
    track_width: float = 0.053
    robot_mass: float = 0.16
    primitive_density: float = 4.0
    gravity: float = 9.81
    tyre_friction: float = 0.9
    floor_friction: float = 0.15
    contact_friction: float = 0.3
    overlap: float = 1e-4
    overlap_after_a_second: float = 1e-12
    step: float = 0.005
    iterations: int = 20
    min_shift: float = 1e-4
    min_turn: float = 1e-3
    outline_points: int = 64


DEFAULTS = SimulatorOptions()


class Simulator:
    """A world's bodies and the robot, which is put anywhere by a supervisor or drives by its wheels.

    Args:
        world: All that stands there at the start; primitives alone can move.
        movable: Whether the robot can push the primitives.
        options: The physics.
    """

    def __init__(self, world: World, movable: bool = False, options: SimulatorOptions = DEFAULTS) -> None:
        self.world = world
        self.options = options
        self._space = pymunk.Space()
        self._space.iterations = options.iterations
        self._space.collision_slop, self._space.collision_bias = options.overlap, options.overlap_after_a_second
        self._bodies = [self._add_primitive(primitive, movable) for primitive in world.primitives]
        edges = [solid.as_segments() for solid in world.solids]
        for x0, y0, x1, y1 in np.vstack([np.asarray(world.walls).reshape(-1, 4), *edges]).tolist():
            wall = pymunk.Segment(self._space.static_body, (x0, y0), (x1, y1), 0.0)
            wall.friction = options.contact_friction
            self._space.add(wall)
        self._solid = shapely.union_all([shapely.Polygon(solid.outline) for solid in world.solids])
        shapely.prepare(self._solid)
        inertia = pymunk.moment_for_circle(options.robot_mass, 0, options.robot_radius)
        self._robot = pymunk.Body(options.robot_mass, inertia)
        self._disc = pymunk.Circle(self._robot, options.robot_radius)
        self._disc.friction = options.contact_friction

    def warp(self, pose: Pose2D) -> bool:
        """Teleport the robot to ``pose``, at rest; return False where it would touch something or stand inside it."""
        if self._disc in self._space.shapes:
            self._space.remove(self._robot, self._disc)
        self._robot.position, self._robot.angle = (pose.x, pose.y), pose.theta
        self._robot.velocity, self._robot.angular_velocity = (0.0, 0.0), 0.0
        self._disc.cache_bb()
        return not self._is_inside(pose.x, pose.y) and not self._space.shape_query(self._disc)

    def clearance(self, x: float, y: float, reach: float) -> float:
        """Compute the distance from a point to the nearest thing that cannot move.

        Args:
            x: The point's x (m).
            y: The point's y (m).
            reach: How far to search (m).

        Returns:
            The distance (m), negative inside a thing, at most ``reach``.
        """
        if self._is_inside(x, y):
            return -float(self._solid.boundary.distance(shapely.Point(x, y)))
        found = self._space.point_query((x, y), reach, pymunk.ShapeFilter())
        return min((hit.distance for hit in found if _is_static(hit.shape)), default=reach)

    def _is_inside(self, x: float, y: float) -> bool:
        """Return whether a point lies inside clutter or structure, of which the space holds the edges alone."""
        return bool(shapely.contains_xy(self._solid, x, y))

    @property
    def pose(self) -> Pose2D:
        """The robot's pose."""
        x, y = self._robot.position
        return Pose2D(x, y, math.remainder(self._robot.angle, 2 * math.pi))

    def drive(self, left: float, right: float, seconds: float) -> None:
        """Turn the wheels at constant speeds for a while.

        Args:
            left: Rim speed of the left wheel (m/s).
            right: Rim speed of the right wheel (m/s).
            seconds: For how long; rounded to whole steps of the simulation.
        """
        if self._disc not in self._space.shapes:
            self._space.add(self._robot, self._disc)
        step, offset = self.options.step, self.options.track_width / 2
        for _ in range(round(seconds / step)):
            self._pull(left, offset)
            self._pull(right, -offset)
            self._space.step(step)

    def current_world(self) -> World:
        """Return the world as it is now: the same object as long as nothing has moved."""
        now = tuple(map(self._moved, self.world.primitives, self._bodies))
        if any(new is not old for new, old in zip(now, self.world.primitives, strict=True)):
            self.world = replace(self.world, primitives=now)
        return self.world

    def _pull(self, rim_speed: float, side: float) -> None:
        """Apply one tyre's friction during a step, with half of the robot's weight on it."""
        body, options = self._robot, self.options
        contact = body.local_to_world((0.0, side))
        slip = body.velocity_at_world_point(contact).rotated(-body.angle)
        impulse = pymunk.Vec2d(rim_speed - slip.x, -slip.y / 2) * (options.robot_mass / 2)
        limit = options.tyre_friction * options.robot_mass / 2 * options.gravity * options.step
        if impulse.length > limit:
            impulse = impulse.normalized() * limit
        body.apply_impulse_at_world_point(impulse.rotated(body.angle), contact)

    def _add_primitive(self, primitive: Primitive, movable: bool) -> pymunk.Body:
        body = pymunk.Body(body_type=pymunk.Body.DYNAMIC if movable else pymunk.Body.STATIC)
        shape = self._shape(primitive, body)
        shape.friction = self.options.contact_friction
        if movable:
            shape.density = self.options.primitive_density
        body.position, body.angle = (primitive.x, primitive.y), primitive.theta or 0.0
        self._space.add(body, shape)
        if movable:
            self._add_floor_friction(body, primitive)
        return body

    def _shape(self, primitive: Primitive, body: pymunk.Body) -> pymunk.Shape:
        if not primitive.kind.has_angle:
            return pymunk.Circle(body, primitive.bounding_radius)
        return pymunk.Poly(body, primitive.local_outline(self.options.outline_points).tolist())

    def _add_floor_friction(self, body: pymunk.Body, primitive: Primitive) -> None:
        """Add Coulomb friction between a movable primitive and the floor, against shifts and against turns.

        The torque is that of a disc of the same area under even pressure: force x 2/3 of its radius.
        """
        force = self.options.floor_friction * body.mass * self.options.gravity
        torque = force * 2 / 3 * math.sqrt(primitive.area / math.pi)
        slide = pymunk.PivotJoint(self._space.static_body, body, (0.0, 0.0), (0.0, 0.0))
        turn = pymunk.GearJoint(self._space.static_body, body, 0.0, 1.0)
        for joint, limit in ((slide, force), (turn, torque)):
            joint.max_bias, joint.max_force, joint.collide_bodies = 0.0, limit, True
            self._space.add(joint)

    def _moved(self, primitive: Primitive, body: pymunk.Body) -> Primitive:
        """Return the primitive where its body is now; itself if that is where it was."""
        turned = math.remainder(body.angle - (primitive.theta or 0.0), primitive.kind.row.period or math.inf)
        shifted = math.hypot(body.position.x - primitive.x, body.position.y - primitive.y)
        is_turned = primitive.theta is not None and abs(turned) >= self.options.min_turn
        if shifted < self.options.min_shift and not is_turned:
            return primitive
        theta = None if primitive.theta is None else body.angle
        return replace(primitive, x=body.position.x, y=body.position.y, theta=theta).canonical()


def _is_static(shape: pymunk.Shape | None) -> bool:
    return shape is not None and shape.body is not None and shape.body.body_type == pymunk.Body.STATIC
