"""States of the six-axis analog IMU board, seen in its ADC counts: at rest, and gyros that put out no rate.

Limits follow the noise of the run, since boards, their supplies and what is wired beside them differ.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import label, maximum_filter1d, minimum_filter1d, uniform_filter1d

from posegraph_slam.arrays import BoolArray, FloatArray

GYRO_REFERENCE = 1230.0 / (3300.0 / 1023.0)
"""Count (381.3) of the gyros' reference of 1.23 V, which they put out while they are powered down or being reset."""
REFERENCE_TOLERANCE = 12.0
"""Counts: 3 % of the reference or of the ADC's supply."""
OUTAGE_SAMPLES = 20
"""0.2 s; within it a channel at the reference is as steady as at rest."""
ONSET_SAMPLES = 4
ONSET_COUNTS = 6.0
"""A body at a steady rate got there gradually; chips that are reset leap by this much on two channels or more."""
MIN_STILL_S = 0.5
MAX_STILL_S = 10.0
STILL_COUNTS = 4.0
"""Still means within this many counts, 4 deg/s or 0.04 g, of the median: the odd outlier of a quiet board."""
STILL_COUNTS_MAX = 16.0
SIGMAS = 5.0


def noise_counts(counts: FloatArray) -> FloatArray:
    """Standard deviation (C,) of white noise on the channels `counts` (C, N), from their successive differences."""
    if counts.shape[1] < 2:
        return np.zeros(counts.shape[0])
    return np.asarray(np.diff(counts, axis=1).std(axis=1) / np.sqrt(2.0))


def find_rest(counts: FloatArray, stamps_s: FloatArray) -> slice | None:
    """Samples of the still start, else of the longest rest of half a second or more; None where there is none."""
    count = still_start(counts, stamps_s)
    if count and stamps_s[count - 1] - stamps_s[0] >= MIN_STILL_S:
        return slice(0, count)
    return _longest_rest(counts, stamps_s)


def still_start(counts: FloatArray, stamps_s: FloatArray) -> int:
    """Count the samples before any channel leaves its median over the first half second, ten seconds at most."""
    elapsed = stamps_s - stamps_s[0]
    first = counts[:, elapsed <= MIN_STILL_S]
    limit = np.clip(SIGMAS * noise_counts(first), STILL_COUNTS, STILL_COUNTS_MAX)
    away = np.abs(counts - np.median(first, axis=1)[:, None]) > limit[:, None]
    moved = away.any(axis=0) | (elapsed > MAX_STILL_S)
    return int(np.argmax(moved)) if moved.any() else len(stamps_s)


def _longest_rest(counts: FloatArray, stamps_s: FloatArray) -> slice | None:
    """The longest stretch in which no channel leaves a band of twice `STILL_COUNTS` within half a second."""
    spacing = float(np.median(np.diff(stamps_s))) if len(stamps_s) > 1 else 0.0
    width = int(np.ceil(MIN_STILL_S / spacing)) + 1 if spacing > 0 else 0
    if not 0 < width <= len(stamps_s):
        return None
    spread = maximum_filter1d(counts, width, axis=1) - minimum_filter1d(counts, width, axis=1)
    still, count = label((spread <= 2.0 * STILL_COUNTS).all(axis=0))
    if count == 0:
        return None
    longest = int(np.argmax(np.bincount(still)[1:])) + 1
    at = np.flatnonzero(still == longest)
    half = width // 2
    return slice(max(int(at[0]) - half, 0), min(int(at[-1]) + width - half, len(stamps_s)))


def gyro_outages(counts: FloatArray, *, zero: FloatArray, noise: float) -> BoolArray:
    """Samples (N,) at which all gyro channels `counts` (3, N) rest at the reference voltage for 0.2 s or more.

    `zero` (3,) are the counts at rest and `noise` their deviation. Channels must be steady, near the reference but not
    all at their zero, and leap there or back: a body that turns slowly and steadily does not.
    """
    found = np.zeros(counts.shape[1], dtype=np.bool_)
    if counts.shape[1] < OUTAGE_SAMPLES:
        return found
    mean = uniform_filter1d(counts, OUTAGE_SAMPLES, axis=1)
    variance = uniform_filter1d(counts**2, OUTAGE_SAMPLES, axis=1) - mean**2
    steady = (variance <= max(1.0, 1.5 * noise) ** 2).all(axis=0)
    steady &= (np.abs(mean - GYRO_REFERENCE) <= REFERENCE_TOLERANCE).all(axis=0)
    steady &= (np.abs(mean - zero[:, None]) > STILL_COUNTS).any(axis=0)
    stretches, count = label(maximum_filter1d(steady.astype(np.uint8), 2 * OUTAGE_SAMPLES - 1))
    for k in range(1, count + 1):
        level = np.median(counts[:, steady & (stretches == k)], axis=1)
        inside = (stretches == k) & (np.abs(counts - level[:, None]) <= max(2.0, 4.0 * noise)).all(axis=0)
        if inside.any() and _leaps(counts, inside, level, ONSET_COUNTS + 3.0 * noise):
            found |= inside
    return found


def _leaps(counts: FloatArray, inside: BoolArray, level: FloatArray, leap: float) -> bool:
    """Whether two channels or more came from farther than `leap` counts just before, or went there just after."""
    first, last = np.flatnonzero(inside)[[0, -1]]
    before, after = counts[:, max(first - ONSET_SAMPLES, 0) : first], counts[:, last + 1 : last + 1 + ONSET_SAMPLES]
    sizes = (np.abs(each - level[:, None]).max(axis=1, initial=0.0) for each in (before, after))
    return any(int((size > leap).sum()) >= 2 for size in sizes)
