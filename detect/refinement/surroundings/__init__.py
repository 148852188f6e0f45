"""What the map says around candidates: cells, straight walls, and components that the networks missed."""

from prim.lazy import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "MapCells": "detect.refinement.surroundings.map_cells",
        "Wall": "detect.refinement.surroundings.walls",
        "propose": "detect.refinement.surroundings.proposals",
    },
)
