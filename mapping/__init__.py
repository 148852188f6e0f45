"""From scans and poses to occupancy grids."""
