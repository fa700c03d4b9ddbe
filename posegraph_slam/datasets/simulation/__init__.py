"""A simulated robot in an indoor world, with its truth."""
