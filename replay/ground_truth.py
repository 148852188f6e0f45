"""The ground truth of a recorded log: exact primitives and walls over time."""

from __future__ import annotations

import bisect
from dataclasses import replace

from prim import strict_json
from prim.errors import WorldError
from prim.log.decoding.codecs import Content
from prim.log.messages import TRUE_PRIMITIVES_TOPIC
from prim.log.source import LogSource
from prim.world import World


class GroundTruth:
    """The true world at any time: walls and floor from ``world.json``, primitives as they were last logged.

    Args:
        world: The world that the log describes as a whole.
        changes: Stamps (ns), ascending, and the worlds that hold from them on.
    """

    def __init__(self, world: World, changes: list[tuple[int, World]]) -> None:
        self.world = world
        self._stamps = [stamp for stamp, _ in changes]
        self._worlds = [changed for _, changed in changes]

    @classmethod
    def read(cls, log: LogSource) -> GroundTruth | None:
        """Read a log's ground truth; None where it holds none.

        Raises:
            WorldError: The log's description of the world is not valid.
            LogReadError: The log is damaged.
        """
        attachment = log.attachment("world.json")
        if attachment is None:
            return None
        try:
            world = World.from_json(strict_json.loads(attachment))
        except ValueError as error:
            raise WorldError(f"its world.json does not describe a world: {error}") from error
        topic = log.topics.get(TRUE_PRIMITIVES_TOPIC)
        if topic is None or topic.content is not Content.PRIMITIVES or not topic.messages:
            return cls(world, [])
        changes = [
            (stamp or log_time, replace(world, primitives=primitives))
            for log_time, (stamp, primitives) in log.decoded(topic)
        ]
        return cls(world, sorted(changes, key=lambda item: item[0]))

    def at(self, stamp: int) -> World:
        """Return the world at ``stamp`` (ns)."""
        index = bisect.bisect_right(self._stamps, stamp) - 1
        return self._worlds[index] if index >= 0 else self.world
