"""Simulated laser logs of the kind of public ones, each with one thing that goes wrong there."""
