"""The truth a recorded log holds: exact primitives and walls over time."""

from __future__ import annotations

import bisect
import json
from dataclasses import replace

from prim.errors import WorldError
from prim.log.mcap import LogReader
from prim.log.messages import MARKERS_TYPE, TRUE_PRIMITIVES_TOPIC, decode_primitives
from prim.world import World


class Truth:
    """The true world at any time: walls and floor from ``world.json``, primitives as they were last logged."""

    def __init__(self, world: World, moved: list[tuple[int, World]]) -> None:
        self.world = world
        self._stamps = [stamp for stamp, _ in moved]
        self._worlds = [world for _, world in moved]

    @classmethod
    def read(cls, log: LogReader) -> Truth | None:
        """The log's truth, None where it holds none.

        Raises WorldError where it does not describe a world, and LogReadError where the log is damaged.
        """
        attachment = log.attachment("world.json")
        if attachment is None:
            return None
        try:
            world = World.from_json(json.loads(attachment))
        except ValueError as error:
            raise WorldError(f"its world.json does not describe a world: {error}") from error
        topic = log.topics.get(TRUE_PRIMITIVES_TOPIC)
        if topic is None or topic.type != MARKERS_TYPE or not topic.messages:
            return cls(world, [])
        moved = [
            (stamp or log_time, replace(world, primitives=primitives))
            for log_time, (stamp, primitives) in log.decoded(topic, decode_primitives)
        ]
        return cls(world, sorted(moved, key=lambda item: item[0]))

    def at(self, stamp: int) -> World:
        """The world at ``stamp`` (ns)."""
        index = bisect.bisect_right(self._stamps, stamp) - 1
        return self._worlds[index] if index >= 0 else self.world
