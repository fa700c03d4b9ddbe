"""Nodes, constraints, noise and the solving of pose graphs; the only room that imports gtsam."""
