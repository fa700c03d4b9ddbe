"""Particle filters: localisation in a known map and SLAM."""
