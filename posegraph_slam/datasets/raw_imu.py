"""From ADC counts to SI units for a six-axis analog IMU board: ADXL335 accelerometer, LPR530AL and LY530ALH gyros.

Channels are Ax Ay Az Wz Wx Wy, converted by a ten-bit ADC of 3.3 V. The gyros' zero levels come from the still first
seconds, sensitivities from the data sheets, and what differs from these on this board from its calibration below.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from posegraph_slam.arrays import BoolArray, FloatArray, read_only
from posegraph_slam.errors import InputError
from posegraph_slam.sensors import STANDARD_GRAVITY, Imu, ImuCalibration

MV_PER_COUNT = 3300.0 / 1023.0
ACCELEROMETER_MV_PER_G = 330.0
GYRO_MV_PER_DEG_S = 3.33
"""Data sheets: both sensitivities are ratiometric or amplified, with a tolerance near ten per cent."""
ACCELEROMETER_SIGN = read_only([-1.0, -1.0, 1.0])
"""Ax and Ay count down when the axis points up."""
MID_SUPPLY = 511.5
"""Data sheet's count of zero acceleration, half the supply; offsets of 0.15 V (46 counts) are within tolerance."""
BOARD = ImuCalibration(
    accelerometer_offset=read_only([0.2428, 1.1156, -0.8554]),
    accelerometer_matrix=read_only([[0.9807, -0.0190, 0.0286], [0.0038, 0.9861, 0.0074], [0.0151, -0.0030, 0.9969]]),
    gyro_matrix=read_only([[0.9159, -0.0086, 0.0138], [-0.0073, 0.9485, 0.0096], [-0.0097, 0.0028, 1.0364]]),
)
"""What `odometry.attitude.calibrate_against_reference` finds for the board in three runs under motion capture.

Two of the runs alone agree to 0.2 % and 0.002 g for the accelerometer and to 1 % for the gyro.
"""
BOARD_TOLERANCE = 0.03
"""At rest the board's calibration gives 1 g within 0.002; another board's offsets and gains would show."""
GYRO_REFERENCE = 1230.0 / MV_PER_COUNT
"""Count (381.3) of the gyros' reference of 1.23 V, which they put out while they are powered down or being reset."""
REFERENCE_TOLERANCE = 4.0
OUTAGE_SAMPLES = 20
"""0.2 s; the noise of a working gyro, 0.6 counts, leaves a range of two counts on all axes within a few samples."""
MIN_STILL_S = 0.5
MAX_STILL_S = 10.0
STILL_COUNTS = 4.0
"""Still means within this many counts, 4 deg/s or 0.04 g, of the median: five sigma and the odd outlier."""
MAX_LEVEL_OFFSET = 0.29 * STANDARD_GRAVITY
"""m/s^2 by which a level start may differ from the data sheet."""


def imu_from_counts(
    counts: FloatArray, stamps_s: FloatArray, *, where: str, board: ImuCalibration | None = BOARD
) -> tuple[Imu, tuple[str, ...]]:
    """Convert `counts` (6, N) into an IMU in rad/s and m/s^2, with remarks on what was found.

    Rates are NaN while the gyros put out their reference voltage. Where `board` does not give 1 g at the start, as on
    another board, the data sheet's gains are used and the start is taken as level. Raises `InputError` naming `where`
    for counts outside 0 to 1023 and for a start that is not still.
    """
    outside = (counts < 0) | (counts > 1023)
    if outside.any():
        index = int(np.argmax(outside.any(axis=0)))
        raise InputError(where, f"counts outside 0 to 1023 at index {index}", "expected the raw values of a 10-bit ADC")
    rest = _rest(counts, stamps_s, where)
    imu = _by_data_sheet(counts, stamps_s, gyro_zero=counts[3:, rest].mean(axis=1))
    remark = f"zero rates from a still start of {stamps_s[rest][-1] - stamps_s[0]:.1f} s"
    force = imu.linear_acceleration[rest].mean(axis=0)
    if board is not None and _is_one_g(board.accelerometer_matrix @ (force - board.accelerometer_offset)):
        imu = board.apply(imu)
    else:
        imu, how = _level_at_start(imu, force)
        remark += f"; {how}"
    silent = gyro_outages(counts[3:])
    if not silent.any():
        return imu, (remark,)
    seconds = float(np.diff(stamps_s, append=stamps_s[-1])[silent].sum())
    at = float(stamps_s[int(np.argmax(silent))] - stamps_s[0])
    outage = f"the gyros put out their reference voltage for {seconds:.2f} s, first at {at:.2f} s: no rates"
    rates = np.where(silent[:, None], np.nan, imu.angular_velocity)
    return replace(imu, angular_velocity=rates), (remark, outage)


def _rest(counts: FloatArray, stamps_s: FloatArray, where: str) -> slice:
    """Samples of the still start."""
    count = still_start(counts, stamps_s)
    seconds = float(stamps_s[count - 1] - stamps_s[0]) if count else 0.0
    if seconds < MIN_STILL_S:
        problem = f"the board moves from the start (still for {seconds:.2f} s, needed {MIN_STILL_S:g} s)"
        raise InputError(where, problem, "the gyros' zero levels cannot be found: start the log at rest")
    return slice(0, count)


def _by_data_sheet(counts: FloatArray, stamps_s: FloatArray, *, gyro_zero: FloatArray) -> Imu:
    """Convert with the data sheets' sensitivities; `gyro_zero` (3,) counts, in the order of the channels."""
    g = ACCELEROMETER_SIGN * MV_PER_COUNT / ACCELEROMETER_MV_PER_G * (counts[:3].T - MID_SUPPLY)
    rates = np.radians(MV_PER_COUNT / GYRO_MV_PER_DEG_S) * (counts[3:].T - gyro_zero)
    return Imu(
        stamps_s=stamps_s,
        angular_velocity=rates[:, [1, 2, 0]],
        linear_acceleration=g * STANDARD_GRAVITY,
        T_base_imu=np.eye(4),
    )


def _is_one_g(force: FloatArray) -> bool:
    return bool(abs(float(np.linalg.norm(force)) / STANDARD_GRAVITY - 1.0) < BOARD_TOLERANCE)


def _level_at_start(imu: Imu, force: FloatArray) -> tuple[Imu, str]:
    """Shift accelerations so that their mean at rest, `force` (3,), is 1 g upwards, where the data sheet allows it."""
    offset = force - [0.0, 0.0, STANDARD_GRAVITY]
    if np.abs(offset).max() > MAX_LEVEL_OFFSET:
        return imu, "the start is not level, so that the accelerometer's zero is half the supply, good to a few degrees"
    shifted = replace(imu, linear_acceleration=imu.linear_acceleration - offset)
    return shifted, "not the known board, so that the start is taken as level and gains are the data sheet's"


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
