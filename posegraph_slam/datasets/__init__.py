"""Readers from file formats to `RobotLog`, and the registry that finds them."""
