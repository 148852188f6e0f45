"""The world as a pymunk space seen from above, with an e-puck-like differential-drive robot in it.

Nothing falls: gravity only presses on the floor. A wheel's tyre pulls the robot towards the wheel's own speed along
its rolling direction and keeps it from slipping sideways, both up to the friction that the tyre has; contacts with
walls and primitives are pymunk's. A movable primitive slides with friction between it and the floor.
"""

from __future__ import annotations

import math
from dataclasses import replace

import pymunk

from prim.se2 import Pose2D
from prim.shapes import Primitive
from prim.world import World

ROBOT_RADIUS = 0.035
"""The e-puck's radius (m)."""

AXLE = 0.053
"""Distance (m) between the e-puck's wheels."""

ROBOT_MASS = 0.16
DENSITY = 4.0
"""Mass of a movable primitive (kg per square metre): hollow boxes, light enough for the robot to push."""

GRAVITY = 9.81
TYRE_FRICTION = 0.9
FLOOR_FRICTION = 0.15
CONTACT_FRICTION = 0.3

OVERLAP, OVERLAP_AFTER_A_SECOND = 1e-4, 1e-12
"""Bodies in contact may overlap by this much (m); of a larger overlap this share remains after a second.

pymunk's own values are made for pixels: with them the robot sinks into walls by centimetres.
"""

STEP = 0.005
"""Seconds per step of the simulation."""

MOVED_METRES, MOVED_RADIANS = 1e-4, 1e-3
"""A primitive that moved by less than this has not moved."""

_OUTLINE_POINTS = 64


class Simulator:
    """A world's bodies and the robot, which a supervisor can put anywhere, or which drives by its wheels."""

    def __init__(self, world: World, robot_radius: float = ROBOT_RADIUS, movable: bool = False) -> None:
        self.world = world
        self.space = pymunk.Space()
        self.space.iterations = 20
        self.space.collision_slop, self.space.collision_bias = OVERLAP, OVERLAP_AFTER_A_SECOND
        self._bodies = [self._add_primitive(primitive, movable) for primitive in world.primitives]
        for x0, y0, x1, y1 in world.walls:
            wall = pymunk.Segment(self.space.static_body, (x0, y0), (x1, y1), 0.0)
            wall.friction = CONTACT_FRICTION
            self.space.add(wall)
        self._robot = pymunk.Body(ROBOT_MASS, pymunk.moment_for_circle(ROBOT_MASS, 0, robot_radius))
        self._disc = pymunk.Circle(self._robot, robot_radius)
        self._disc.friction = CONTACT_FRICTION

    def warp(self, pose: Pose2D) -> bool:
        """Puts the robot at ``pose``, at rest; False where it would stand inside something or touch it."""
        if self._disc in self.space.shapes:
            self.space.remove(self._robot, self._disc)
        self._robot.position, self._robot.angle = (pose.x, pose.y), pose.theta
        self._robot.velocity, self._robot.angular_velocity = (0.0, 0.0), 0.0
        self._disc.cache_bb()
        return not self.space.shape_query(self._disc)

    def clearance(self, x: float, y: float, reach: float) -> float:
        """Distance (m) from a point to the nearest thing that cannot move, at most ``reach``; negative inside it."""
        found = self.space.point_query((x, y), reach, pymunk.ShapeFilter())
        return min((hit.distance for hit in found if _stands_still(hit.shape)), default=reach)

    @property
    def pose(self) -> Pose2D:
        """Where the robot is."""
        x, y = self._robot.position
        return Pose2D(x, y, math.remainder(self._robot.angle, 2 * math.pi))

    def drive(self, left: float, right: float, seconds: float) -> None:
        """Turns the wheels at these rim speeds (m/s) for a while."""
        if self._disc not in self.space.shapes:
            self.space.add(self._robot, self._disc)
        for _ in range(round(seconds / STEP)):
            self._pull(left, AXLE / 2)
            self._pull(right, -AXLE / 2)
            self.space.step(STEP)

    def moved_world(self) -> World:
        """The world as it is now: the same object as long as nothing has moved."""
        now = tuple(map(_moved, self.world.primitives, self._bodies))
        if any(new is not old for new, old in zip(now, self.world.primitives, strict=True)):
            self.world = replace(self.world, primitives=now)
        return self.world

    def _pull(self, rim_speed: float, side: float) -> None:
        """One tyre's friction during a step: it takes half the robot's weight and half of what it should change."""
        body = self._robot
        at = body.local_to_world((0.0, side))
        slip = body.velocity_at_world_point(at).rotated(-body.angle)
        wanted = pymunk.Vec2d(rim_speed - slip.x, -slip.y / 2) * (ROBOT_MASS / 2)
        most = TYRE_FRICTION * ROBOT_MASS / 2 * GRAVITY * STEP
        if wanted.length > most:
            wanted = wanted.normalized() * most
        body.apply_impulse_at_world_point(wanted.rotated(body.angle), at)

    def _add_primitive(self, primitive: Primitive, movable: bool) -> pymunk.Body:
        body = pymunk.Body(body_type=pymunk.Body.DYNAMIC if movable else pymunk.Body.STATIC)
        shape = _shape(primitive, body)
        shape.friction = CONTACT_FRICTION
        if movable:
            shape.density = DENSITY
        body.position, body.angle = (primitive.x, primitive.y), primitive.theta or 0.0
        self.space.add(body, shape)
        if movable:
            self._rub_on_floor(body, primitive)
        return body

    def _rub_on_floor(self, body: pymunk.Body, primitive: Primitive) -> None:
        """Sliding friction between a movable primitive and the floor, against shifts and against turns."""
        force = FLOOR_FRICTION * body.mass * GRAVITY
        slide = pymunk.PivotJoint(self.space.static_body, body, (0.0, 0.0), (0.0, 0.0))
        turn = pymunk.GearJoint(self.space.static_body, body, 0.0, 1.0)
        for joint, most in ((slide, force), (turn, force * 2 / 3 * math.sqrt(primitive.area / math.pi))):
            joint.max_bias, joint.max_force, joint.collide_bodies = 0.0, most, True
            self.space.add(joint)


def _stands_still(shape: pymunk.Shape | None) -> bool:
    return shape is not None and shape.body is not None and shape.body.body_type == pymunk.Body.STATIC


def _moved(primitive: Primitive, body: pymunk.Body) -> Primitive:
    """The primitive where its body is now; itself if that is where it was."""
    turned = math.remainder(body.angle - (primitive.theta or 0.0), primitive.kind.row.period or math.inf)
    still = math.hypot(body.position.x - primitive.x, body.position.y - primitive.y) < MOVED_METRES
    if still and (primitive.theta is None or abs(turned) < MOVED_RADIANS):
        return primitive
    theta = None if primitive.theta is None else body.angle
    return replace(primitive, x=body.position.x, y=body.position.y, theta=theta).canonical()


def _shape(primitive: Primitive, body: pymunk.Body) -> pymunk.Shape:
    if not primitive.kind.has_angle:
        return pymunk.Circle(body, primitive.circumradius)
    return pymunk.Poly(body, primitive.local_outline(_OUTLINE_POINTS).tolist())
