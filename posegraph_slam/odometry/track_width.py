"""Effective track width: the width at which the wheels' difference agrees with the gyro."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import FloatArray

WINDOW_S = 1.0
"""Turns are compared over windows of this length, so that the rounding to whole ticks does not matter."""
MIN_TURN_RAD = 1.0
"""Sum of |turn| over the windows below which the logged width is kept."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackWidth:
    """`metres` with its standard error; `fitted` is False where the log's own width had to be kept."""

    metres: float
    sigma_m: float
    fitted: bool
    remark: str


def estimate_track_width(
    stamps_s: FloatArray, difference_m: FloatArray, turn_rad: FloatArray, *, nominal_m: float
) -> TrackWidth:
    """Fit width in difference = width x turn by robust least squares over windows of a second.

    `stamps_s` (N,) ends of the steps that the gyro covers, `difference_m` (N,) right beyond left travel and `turn_rad`
    (N,) the gyro's turn of the same steps. A skid-steered robot slips sideways when it turns, so that the width is
    larger than the geometric one. The gyro is taken as exact, the wheels as noisy (Huber weights, scale from the
    median). Too little turning, or wheels that contradict the gyro, keep `nominal_m`.
    """
    if len(stamps_s) == 0:
        return TrackWidth(metres=nominal_m, sigma_m=0.3 * nominal_m, fitted=False, remark="")
    window = ((stamps_s - stamps_s[0]) / WINDOW_S).astype(np.int64)
    turn, difference = np.bincount(window, turn_rad), np.bincount(window, difference_m)
    if np.abs(turn).sum() < MIN_TURN_RAD:
        return TrackWidth(
            metres=nominal_m, sigma_m=0.3 * nominal_m, fitted=False,
            remark=f"the robot hardly turns: the track width {nominal_m:.3f} m of the log is kept",
        )  # fmt: skip
    weight = np.ones_like(turn)
    for _ in range(20):
        normal = float(weight @ turn**2)
        width = float(weight @ (turn * difference)) / normal
        residual = difference - width * turn
        moving = np.abs(turn) > 0.02
        scale = max(1.4826 * float(np.median(np.abs(residual[moving]))) if moving.any() else 0.0, 1e-9)
        weight = np.minimum(1.0, 1.345 * scale / np.maximum(np.abs(residual), 1e-12))
    sigma = float(np.sqrt(weight**2 @ (residual * turn) ** 2)) / normal
    if width <= 0 or sigma > 0.3 * width:
        return TrackWidth(
            metres=nominal_m, sigma_m=0.3 * nominal_m, fitted=False,
            remark="wheels and gyro disagree on the direction of turns: check which side is left and the mounting of "
            f"the imu; the track width {nominal_m:.3f} m of the log is kept",
        )  # fmt: skip
    return TrackWidth(
        metres=width, sigma_m=sigma, fitted=True,
        remark=f"effective track width {width:.3f} ± {sigma:.3f} m from wheels and gyro",
    )  # fmt: skip
