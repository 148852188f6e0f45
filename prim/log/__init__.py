"""Logs: reading, writing, recovering; messages and their bytes."""
