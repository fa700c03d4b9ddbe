"""Motion models, alignment of streams in time, and scan-matching odometry."""
