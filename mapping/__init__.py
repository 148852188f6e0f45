"""Mapping: from scans at known poses to occupancy grids."""
