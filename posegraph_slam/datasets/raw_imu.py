"""From ADC counts to SI units for a six-axis analog IMU board: ADXL335 accelerometer, LPR530AL and LY530ALH gyros.

Channels are Ax Ay Az Wz Wx Wy, converted by a ten-bit ADC of 3.3 V. Zero levels come from the still first seconds, in
which the board lies level; sensitivities are the data sheets' times the gains of the board below.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from posegraph_slam.arrays import BoolArray, FloatArray, read_only
from posegraph_slam.errors import InputError
from posegraph_slam.sensors import STANDARD_GRAVITY, Imu

MV_PER_COUNT = 3300.0 / 1023.0
ACCELEROMETER_MV_PER_G = 330.0
GYRO_MV_PER_DEG_S = 3.33
"""Data sheets: both sensitivities are ratiometric or amplified, with a tolerance near ten per cent."""
ACCELEROMETER_GAIN = 1.022
"""Found from gravity: over the quiet moments of two runs that tilt the board by 90 degrees |a| is 1 g on average."""
GYRO_GAIN = read_only([1 / 0.909, 1 / 0.939, 1 / 1.047])
"""x, y, z: found from gravity as the rates under which the vertical, seen from the turning board, stays where it was.

`odometry.attitude.calibration` finds them in three runs, to 0.012, 0.013 and 0.033, and leaving any one run out; truth
has no part in them.
"""
ACCELEROMETER_SIGN = read_only([-1.0, -1.0, 1.0])
"""Ax and Ay count down when the axis points up."""
MID_SUPPLY = 511.5
"""Data sheet's count of zero acceleration, half the supply; offsets of 0.15 V (46 counts) are within tolerance."""
GYRO_REFERENCE = 1230.0 / MV_PER_COUNT
"""Count (381.3) of the gyros' reference of 1.23 V, which they put out while they are powered down or being reset."""
REFERENCE_TOLERANCE = 4.0
OUTAGE_SAMPLES = 20
"""0.2 s; the noise of a working gyro, 0.6 counts, leaves a range of two counts on all axes within a few samples."""
MIN_STILL_S = 0.5
MAX_STILL_S = 10.0
STILL_COUNTS = 4.0
"""Still means within this many counts, 4 deg/s or 0.04 g, of the median: five sigma and the odd outlier."""
MAX_LEVEL_OFFSET = 30.0
"""Counts (0.29 g) by which a level start may differ from the data sheet."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RawCalibration:
    """Zero counts (3,) of accelerometer and gyro, in x, y, z, and a sentence on how they were found."""

    accelerometer_zero: FloatArray
    gyro_zero: FloatArray
    remark: str


def imu_from_counts(counts: FloatArray, stamps_s: FloatArray, *, where: str) -> tuple[Imu, tuple[str, ...]]:
    """Convert `counts` (6, N) into an IMU in rad/s and m/s^2, with remarks on what was found.

    Rates are NaN while the gyros put out their reference voltage. Raises `InputError` naming `where` for counts outside
    0 to 1023 and for a start that is not still.
    """
    outside = (counts < 0) | (counts > 1023)
    if outside.any():
        index = int(np.argmax(outside.any(axis=0)))
        raise InputError(where, f"counts outside 0 to 1023 at index {index}", "expected the raw values of a 10-bit ADC")
    calibration = calibrate(counts, stamps_s, where=where)
    accel = (counts[:3].T - calibration.accelerometer_zero) / (_counts_per_g() * ACCELEROMETER_SIGN)
    rate_scale = np.radians(MV_PER_COUNT / (GYRO_MV_PER_DEG_S * GYRO_GAIN))
    omega = (counts[[4, 5, 3]].T - calibration.gyro_zero) * rate_scale
    silent = gyro_outages(counts[3:])
    omega[silent] = np.nan
    remarks = [calibration.remark]
    if silent.any():
        seconds = float(np.diff(stamps_s, append=stamps_s[-1])[silent].sum())
        at = float(stamps_s[int(np.argmax(silent))] - stamps_s[0])
        remarks.append(f"the gyros put out their reference voltage for {seconds:.2f} s, first at {at:.2f} s: no rates")
    imu = Imu(
        stamps_s=stamps_s, angular_velocity=omega, linear_acceleration=accel * STANDARD_GRAVITY, T_base_imu=np.eye(4)
    )
    return imu, tuple(remarks)


def calibrate(counts: FloatArray, stamps_s: FloatArray, *, where: str) -> RawCalibration:
    """Take the zero counts from the still start; the vertical axis is one g above its zero.

    A start that differs from level by more than the data sheet allows leaves the accelerometer at half the supply.
    """
    count = still_start(counts, stamps_s)
    seconds = float(stamps_s[count - 1] - stamps_s[0]) if count else 0.0
    if seconds < MIN_STILL_S:
        problem = f"the board moves from the start (still for {seconds:.2f} s, needed {MIN_STILL_S:g} s)"
        raise InputError(where, problem, "the gyros' zero levels cannot be found: start the log at rest")
    mean = counts[:, :count].mean(axis=1)
    zero = mean[:3] - [0.0, 0.0, _counts_per_g()]
    remark = f"zero levels from a still start of {seconds:.1f} s"
    if np.abs(zero - MID_SUPPLY).max() > MAX_LEVEL_OFFSET:
        zero = np.full(3, MID_SUPPLY)
        remark += "; it is not level, so that the accelerometer's zero is half the supply, good to a few degrees"
    return RawCalibration(accelerometer_zero=zero, gyro_zero=mean[[4, 5, 3]], remark=remark)


def still_start(counts: FloatArray, stamps_s: FloatArray) -> int:
    """Count the samples before any channel leaves its median over the first half second, ten seconds at most."""
    elapsed = stamps_s - stamps_s[0]
    middle = np.median(counts[:, elapsed <= MIN_STILL_S], axis=1)
    moved = (np.abs(counts - middle[:, None]) > STILL_COUNTS).any(axis=0) | (elapsed > MAX_STILL_S)
    return int(np.argmax(moved)) if moved.any() else len(stamps_s)


def gyro_outages(counts: FloatArray) -> BoolArray:
    """Samples (N,) at which all gyro channels `counts` (3, N) rest at the reference voltage for 0.2 s or more."""
    if counts.shape[1] < OUTAGE_SAMPLES:
        return np.zeros(counts.shape[1], dtype=np.bool_)
    spread = maximum_filter1d(counts, OUTAGE_SAMPLES, axis=1) - minimum_filter1d(counts, OUTAGE_SAMPLES, axis=1)
    at_reference = np.asarray(np.abs(counts - GYRO_REFERENCE) <= REFERENCE_TOLERANCE).all(axis=0)
    core = at_reference & (spread <= 2.0).all(axis=0)
    around = maximum_filter1d(core.astype(np.uint8), 2 * OUTAGE_SAMPLES - 1) > 0
    return np.asarray(around & at_reference)


def _counts_per_g() -> float:
    return ACCELEROMETER_MV_PER_G * ACCELEROMETER_GAIN / MV_PER_COUNT
