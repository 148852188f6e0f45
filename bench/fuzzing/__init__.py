"""Damaged and hostile inputs, made at random."""
