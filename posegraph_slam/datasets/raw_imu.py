"""From ADC counts to SI units for a six-axis analog IMU board: ADXL335 accelerometer, LPR530AL and LY530ALH gyros.

Channels are Ax Ay Az Wz Wx Wy, converted by a ten-bit ADC of 3.3 V. The gyros' zero levels come from the still first
seconds, sensitivities from the data sheets, and what differs from these on this board from its calibration below.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from posegraph_slam.arrays import FloatArray, read_only
from posegraph_slam.datasets.raw_imu_gravity import calibrate_by_gravity, excess_of_gravity
from posegraph_slam.datasets.raw_imu_states import MIN_STILL_S, find_rest, gyro_outages, noise_counts
from posegraph_slam.errors import InputError
from posegraph_slam.sensors import STANDARD_GRAVITY, Imu, ImuCalibration

ADC_MAX = 1023
MV_PER_COUNT = 3300.0 / ADC_MAX
ACCELEROMETER_MV_PER_G = 330.0
GYRO_MV_PER_DEG_S = 3.33
"""Data sheets: both sensitivities are ratiometric or amplified, with a tolerance near ten per cent."""
DATA_SHEET_GAIN_SIGMA = 0.1
BOARD_GAIN_SIGMA = 0.03
"""Relative; what supply and temperature do to the gyro of a board that was calibrated."""
ACCELEROMETER_SIGN = read_only([-1.0, -1.0, 1.0])
"""Ax and Ay count down when the axis points up."""
MID_SUPPLY = 511.5
"""Data sheet's count of zero acceleration, half the supply; offsets of 0.15 V (46 counts) are within tolerance."""
BOARD = ImuCalibration(
    accelerometer_offset=read_only([0.2428, 1.1156, -0.8554]),
    accelerometer_matrix=read_only([[0.9807, -0.0190, 0.0286], [0.0038, 0.9861, 0.0074], [0.0151, -0.0030, 0.9969]]),
    gyro_matrix=read_only([[0.9159, -0.0086, 0.0138], [-0.0073, 0.9485, 0.0096], [-0.0097, 0.0028, 1.0364]]),
    early_s=0.0195,
)
"""What `odometry.attitude.calibrate_against_reference` finds for the board in three runs under motion capture.

Two of the runs alone agree to 0.2 % and 0.002 g for the accelerometer and to 1 % for the gyro. Its stamps are earlier
than those of the motion capture by 26, 26 and 6 ms.
"""
BOARD_GYRO_NOISE = 0.6
"""Counts."""
BOARD_TOLERANCE = 0.05
"""At rest the board's calibration gives 1 g within 0.002; another board's zero would show, 0.08 by the data sheet."""
NEARLY_AS_GOOD = 1.05
BOARD_EXCESS = 0.07
"""By what the board's misfit to gravity over a run may exceed that of a fit to the run: this, beyond that factor."""
WORTH_KNOWING = 0.005
"""By how much less the misfit with the known board's axes has to be than with the data sheet's."""
BOARD_GYRO_ZERO = read_only([369.6, 373.6, 375.4])
"""Counts at rest of Wz, Wx and Wy of the known board: the same to 0.2 counts (0.2 deg/s) in three runs."""


def imu_from_counts(
    counts: FloatArray, stamps_s: FloatArray, *, where: str, board: ImuCalibration | None = BOARD
) -> tuple[Imu, tuple[str, ...]]:
    """Convert `counts` (6, N) into an IMU in rad/s and m/s^2, with remarks on what was found.

    Rates are NaN while the gyros put out their reference voltage. Where `board` does not give 1 g, as on another one,
    the accelerometer is calibrated by the size of gravity and the gyro has the data sheet's gains. Raises `InputError`
    naming `where` for counts outside 0 to 1023 and for an unknown board that never rests.
    """
    counts = np.asarray(counts, dtype=np.float64)
    outside = (counts < 0) | (counts > ADC_MAX)
    if outside.any():
        index = int(np.argmax(outside.any(axis=0)))
        raise InputError(where, f"counts outside 0 to 1023 at index {index}", "expected the raw values of a 10-bit ADC")
    rest = find_rest(counts, stamps_s)
    zero = BOARD_GYRO_ZERO if rest is None else counts[3:, rest].mean(axis=1)
    imu = _by_data_sheet(counts, stamps_s, gyro_zero=zero)
    remark = _remark(rest, stamps_s)
    noise = BOARD_GYRO_NOISE if rest is None else float(noise_counts(counts[3:, rest]).max())
    silent = gyro_outages(counts[3:], zero=zero, noise=noise)
    imu = replace(imu, angular_velocity=np.where(silent[:, None], np.nan, imu.angular_velocity))
    imu, how = _calibrated(imu, board, rest)
    if rest is None and how:
        raise InputError(
            where, f"the board never rests for {MIN_STILL_S:g} s", "the gyros' zero levels cannot be found"
        )
    remarks = (remark + how, *_clipped(counts[3:], stamps_s))
    if not silent.any():
        return imu, remarks
    seconds = float(np.diff(stamps_s, append=stamps_s[-1])[silent].sum())
    at = float(stamps_s[int(np.argmax(silent))] - stamps_s[0])
    return imu, (
        *remarks,
        f"the gyros put out their reference voltage for {seconds:.2f} s, first at {at:.2f} s: no rates",
    )


def _remark(rest: slice | None, stamps_s: FloatArray) -> str:
    if rest is None:
        return f"the board never rests for {MIN_STILL_S:g} s: zero rates are those of the known board"
    first, seconds = stamps_s[rest][0] - stamps_s[0], stamps_s[rest][-1] - stamps_s[rest][0]
    if rest.start == 0:
        return f"zero rates from a still start of {seconds:.1f} s"
    return f"the board moves from the start: zero rates from a rest of {seconds:.1f} s at {first:.1f} s"


def _clipped(counts: FloatArray, stamps_s: FloatArray) -> tuple[str, ...]:
    """Tell where gyro channels `counts` (3, N) are at an end of the ADC's range: the body turned faster than that."""
    clipped = ((counts <= 0) | (counts >= ADC_MAX)).any(axis=0)
    if not clipped.any():
        return ()
    seconds = float(np.diff(stamps_s, append=stamps_s[-1])[clipped].sum())
    at = float(stamps_s[int(np.argmax(clipped))] - stamps_s[0])
    return (f"the gyros are at the end of their range for {seconds:.2f} s, first at {at:.2f} s: they turned faster",)


def _by_data_sheet(counts: FloatArray, stamps_s: FloatArray, *, gyro_zero: FloatArray) -> Imu:
    """Convert with the data sheets' sensitivities; `gyro_zero` (3,) counts, in the order of the channels."""
    g = ACCELEROMETER_SIGN * MV_PER_COUNT / ACCELEROMETER_MV_PER_G * (counts[:3].T - MID_SUPPLY)
    rates = np.radians(MV_PER_COUNT / GYRO_MV_PER_DEG_S) * (counts[3:].T - gyro_zero)
    return Imu(
        stamps_s=stamps_s,
        angular_velocity=rates[:, [1, 2, 0]],
        linear_acceleration=g * STANDARD_GRAVITY,
        T_base_imu=np.eye(4),
        gyro_gain_sigma=DATA_SHEET_GAIN_SIGMA,
    )


def _calibrated(imu: Imu, board: ImuCalibration | None, rest: slice | None) -> tuple[Imu, str]:
    """Calibrate by what makes forces the size of gravity over the run, and tell what that is unless it is `board`.

    That is `board` as it stands where it is nearly as good as a fit; else its axes and gyro with an accelerometer of
    other zero and gains, or the data sheet's with these, whichever fits better.
    """
    known = [] if board is None else [replace(board.apply(imu), gyro_gain_sigma=BOARD_GAIN_SIGMA)]
    fits = [_fitted_to_gravity(each, rest) for each in (*known, imu)]
    excess = [excess_of_gravity(each) for each in (*known, *(fit for fit, _ in fits))]
    if known and _is_one_g(known[0], rest) and excess[0] < NEARLY_AS_GOOD * min(excess) + BOARD_EXCESS:
        return known[0], ""
    by_board = bool(known) and excess[1] < excess[2] - WORTH_KNOWING
    fit, level = fits[0 if by_board else -1]
    axes = "the known board's axes and gyro" if by_board else "the data sheet's axes and gyro"
    lean = " and a level start" if level else ""
    return fit, f"; not the known board: {axes}, the accelerometer's zero and gains from the size of gravity{lean}"


def _is_one_g(imu: Imu, rest: slice | None) -> bool:
    """Whether forces at rest, or over a run without rest, have the size of gravity (their median)."""
    size = float(np.median(np.linalg.norm(imu.linear_acceleration[rest or slice(None)], axis=1)))
    return abs(size / STANDARD_GRAVITY - 1.0) < BOARD_TOLERANCE


def _fitted_to_gravity(imu: Imu, rest: slice | None) -> tuple[Imu, bool]:
    start = imu.linear_acceleration[rest].mean(axis=0) if rest is not None and rest.start == 0 else None
    calibration, level = calibrate_by_gravity(imu, start)
    return calibration.apply(imu), level
