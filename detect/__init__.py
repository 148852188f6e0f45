"""From occupancy grids to primitives: detection, refinement and tracking, and training and evaluation of networks."""
