"""Hostile and damaged inputs by kind, the workers that replay them, and what counts as a finding (bench.fuzz)."""
