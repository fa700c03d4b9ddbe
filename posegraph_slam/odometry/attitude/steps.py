"""Rates over the steps between the samples of an IMU."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray


def steps(stamps_s: FloatArray, omega: FloatArray, max_gap_s: float) -> tuple[FloatArray, FloatArray]:
    """Durations (N,) of the steps that end at each sample and the mean rates (N, 3) over them; the first has none.

    The mean of the rates at both ends is exact to second order. Over a gap longer than `max_gap_s` the rate is NaN.
    """
    dt = np.diff(stamps_s, prepend=stamps_s[0])
    rates = 0.5 * (omega + np.concatenate([omega[:1], omega[:-1]]))
    rates[dt > max_gap_s] = np.nan
    return dt, rates
