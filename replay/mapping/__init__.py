"""The map of a replay: its place and size, the memory that it may take, and the stage that adds scan after scan."""

from prim.lazy import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "MappingStage": "replay.mapping.stage",
        "MemoryBudget": "replay.mapping.memory",
        "choose_map_bounds": "replay.mapping.bounds",
    },
)
