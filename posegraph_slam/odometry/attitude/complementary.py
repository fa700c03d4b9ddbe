"""Baselines: the gyro integrated alone, and a complementary filter that leans it towards the accelerometer."""

from __future__ import annotations

import math

import numpy as np

from posegraph_slam.jit import kernel
from posegraph_slam.odometry.attitude.quaternions import turn_in_body, up_in_body


@kernel
def complementary_stream(dt, omega, accel, gravity, max_excess, time_constant, q):  # type: ignore[no-untyped-def]
    """Integrate rates `omega` (N, 3), free of bias, from q (4,); return quaternions (N, 4).

    After each step the body turns towards the measured vertical by the share dt / `time_constant` of the angle between
    (Mahony et al. 2008, eq. 48), where | |accel|/g - 1 | is at most `max_excess`. An infinite time constant leaves the
    gyro alone; a rate that is not finite counts as zero.
    """
    quaternions, up = np.empty((len(dt), 4)), np.empty(3)
    for k in range(len(dt)):
        x, y, z = omega[k, 0] * dt[k], omega[k, 1] * dt[k], omega[k, 2] * dt[k]
        if math.isfinite(x + y + z):
            turn_in_body(q, x, y, z, q)
        a, b, c = accel[k]
        size = math.sqrt(a * a + b * b + c * c)
        if abs(size / gravity - 1.0) <= max_excess and size > 0.0:
            up_in_body(q, up)
            # measured x predicted: the turn that brings the predicted vertical onto the measured one
            share = min(dt[k] / time_constant, 1.0) / size
            x, y, z = b * up[2] - c * up[1], c * up[0] - a * up[2], a * up[1] - b * up[0]
            turn_in_body(q, share * x, share * y, share * z, q)
        quaternions[k] = q
    return quaternions
