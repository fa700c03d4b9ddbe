"""Proposing loop closures and verifying them."""
