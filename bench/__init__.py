"""Measurements that anyone can repeat: maps, speed, damaged logs."""
