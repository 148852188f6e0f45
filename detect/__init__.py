"""Grid to primitives: what is seen on an occupancy grid, and how the networks that see it are made."""
