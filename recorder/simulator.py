"""The world as a pymunk space, with an e-puck-like robot in it."""

from __future__ import annotations

import pymunk

from prim.frames import Pose2D
from prim.shapes import Kind, Primitive
from prim.world import World

ROBOT_RADIUS = 0.035
"""The e-puck's radius (m)."""

_OUTLINE_POINTS = 64


class Simulator:
    """A world's solid bodies and the robot, a disc that a supervisor can put anywhere."""

    def __init__(self, world: World, robot_radius: float = ROBOT_RADIUS) -> None:
        self.space = pymunk.Space()
        for primitive in world.primitives:
            body = pymunk.Body(body_type=pymunk.Body.STATIC)
            body.position = primitive.x, primitive.y
            body.angle = primitive.theta or 0.0
            self.space.add(body, _shape(primitive, body))
        for x0, y0, x1, y1 in world.walls:
            self.space.add(pymunk.Segment(self.space.static_body, (x0, y0), (x1, y1), 0.0))
        self._body = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
        self._robot = pymunk.Circle(self._body, robot_radius)

    def warp(self, pose: Pose2D) -> bool:
        """Puts the robot at ``pose``; False where it would stand inside something or touch it."""
        self._body.position = pose.x, pose.y
        self._body.angle = pose.theta
        self._robot.cache_bb()
        return not self.space.shape_query(self._robot)


def _shape(primitive: Primitive, body: pymunk.Body) -> pymunk.Shape:
    if primitive.kind is Kind.CIRCLE:
        return pymunk.Circle(body, primitive.size[0])
    return pymunk.Poly(body, primitive.local_outline(_OUTLINE_POINTS).tolist())
