"""Yaw-rate bias of a gyro from the stretches in which the robot stands still."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import BoolArray, FloatArray, IntArray, read_only
from posegraph_slam.odometry.settings import GyroBiasSettings
from posegraph_slam.sensors import Imu, WheelEncoders

MIN_SAMPLES = 20
"""Fewer gyro samples than this do not settle a spread."""
BLOCK_S = 0.5
"""Means over blocks of this length count as independent; neighbouring samples of a filtered gyro are not."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GyroBias:
    """`rad_s` is subtracted from the yaw rate; `sigma_rad_s` its standard error; `still_s` (K, 2) the still stretches.

    `noise_density` is the gyro's white noise in rad/sqrt(s), zero where no stretch was found.
    """

    rad_s: float
    sigma_rad_s: float
    noise_density: float
    still_s: FloatArray
    remarks: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "still_s", read_only(self.still_s))


def yaw_rate(imu: Imu) -> FloatArray:
    """Turn rate (N,) about the z axis of the base, rad/s, of an imu mounted in any attitude."""
    return np.asarray(imu.angular_velocity @ imu.T_base_imu[2, :3])


def runs(flags: BoolArray) -> tuple[IntArray, IntArray]:
    """First index (K,) and index after the last (K,) of every run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return edges[::2], edges[1::2]


def wheels_at_rest(encoders: WheelEncoders, settings: GyroBiasSettings) -> FloatArray:
    """Stretches (K, 2) [start, end] in seconds in which no wheel ticks, margins cut off, long enough to count.

    The ticks of stamp k rolled since stamp k-1, so that a run of zeros from k on starts at stamp k-1.
    """
    ticks = np.concatenate([encoders.ticks_left, encoders.ticks_right], axis=1)
    first, after = runs(np.all(ticks[1:] == 0, axis=1))
    start, end = encoders.stamps_s[first] + settings.margin_s, encoders.stamps_s[after] - settings.margin_s
    return np.stack([start, end], axis=1)[end - start >= settings.min_still_s]


def _mean_and_error(stamps: FloatArray, rates: FloatArray) -> tuple[float, float]:
    """Mean rate and its standard error, the larger of that of white noise and of the scatter of block means."""
    white = float(rates.std(ddof=1) / np.sqrt(len(rates)))
    block = ((stamps - stamps[0]) / BLOCK_S).astype(np.int64)
    count = np.bincount(block)
    means = np.bincount(block, weights=rates)[count > 0] / count[count > 0]
    scatter = float(means.std(ddof=1) / np.sqrt(len(means))) if len(means) >= 8 else 0.0
    return float(rates.mean()), max(white, scatter, 1e-9)


def estimate_gyro_bias(encoders: WheelEncoders, imu: Imu, settings: GyroBiasSettings) -> GyroBias:
    """Estimate the yaw-rate bias from all stretches in which the wheels rest and the gyro is quiet.

    Stretches are weighted by their standard errors; where they disagree by more than these (a drifting bias) the
    standard error is widened by the square root of the reduced chi-square. A robot that never stands still gets bias 0
    with `settings.unknown_sigma_rad_s` and a remark.
    """
    rates, found, spreads = yaw_rate(imu), [], []
    stretches = wheels_at_rest(encoders, settings)
    ranges = np.searchsorted(imu.stamps_s, stretches)
    for stretch, (start, end) in zip(stretches, ranges, strict=True):
        rate = rates[start:end]
        if len(rate) < MIN_SAMPLES:
            continue
        mean, error = _mean_and_error(imu.stamps_s[start:end], rate)
        if rate.std() <= settings.max_gyro_std_rad_s and abs(mean) <= settings.max_bias_rad_s:
            found.append((mean, error, *stretch))
            spreads.append(rate.var() * (imu.stamps_s[end - 1] - imu.stamps_s[start]) / (end - start - 1))
    if not found:
        remark = (
            "the robot never stands still while its gyro runs: the gyro bias is taken as 0 "
            f"± {settings.unknown_sigma_rad_s:g} rad/s"
        )
        return GyroBias(rad_s=0.0, sigma_rad_s=settings.unknown_sigma_rad_s, noise_density=0.0,
                        still_s=np.zeros((0, 2)), remarks=(remark,))  # fmt: skip
    mean, error, start_s, end_s = np.array(found).T
    weight = 1 / error**2
    bias = float(weight @ mean / weight.sum())
    reduced = float(weight @ (mean - bias) ** 2) / max(len(mean) - 1, 1)
    sigma = float(np.sqrt(max(reduced, 1.0) / weight.sum()))
    still = np.stack([start_s, end_s], axis=1)
    remark = (
        f"gyro bias {bias:.2e} ± {sigma:.1e} rad/s from {len(still)} still "
        f"{'stretch' if len(still) == 1 else 'stretches'} of {float(np.sum(end_s - start_s)):.1f} s"
    )
    return GyroBias(rad_s=bias, sigma_rad_s=sigma, noise_density=float(np.sqrt(np.median(spreads))), still_s=still,
                    remarks=(remark,))  # fmt: skip
