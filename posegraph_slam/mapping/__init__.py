"""Occupancy, floor and texture maps rebuilt from a trajectory, and their files."""
