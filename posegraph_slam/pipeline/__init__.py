"""Typed configuration, the stages in order, and the run directory."""
