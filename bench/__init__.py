"""Benchmarks and side-by-side measurements: maps, poses, detection, refinement, speed, damaged logs."""
