"""Exact integral of a sampled yaw rate between any two times, with its gaps known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from posegraph_slam.arrays import FloatArray, read_only


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GyroIntegral:
    """Running integral of a rate that is linear between its samples and unknown in gaps and outside.

    `stamps_s` (N,), `rates` (N,), `angle` (N,) the integral up to each sample, `covered_s` (N,) the known time up to
    it, `slope` (N-1,) rad/s^2 and `known` (N-1,) 1 or 0 of the pieces between samples.
    """

    stamps_s: FloatArray
    rates: FloatArray
    angle: FloatArray
    covered_s: FloatArray
    slope: FloatArray
    known: FloatArray

    def __post_init__(self) -> None:
        for name in ("stamps_s", "rates", "angle", "covered_s", "slope", "known"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def at(self, stamps_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Integral (M,) and known time (M,) up to `stamps_s` (M,); differences of two are those of the time between."""
        t = np.clip(stamps_s, self.stamps_s[0], self.stamps_s[-1])
        piece = np.clip(np.searchsorted(self.stamps_s, t, side="right") - 1, 0, len(self.slope) - 1)
        s = (t - self.stamps_s[piece]) * self.known[piece]
        angle = self.angle[piece] + self.rates[piece] * s + 0.5 * self.slope[piece] * s**2
        return angle, self.covered_s[piece] + s


def integrate_rate(stamps_s: FloatArray, rates: FloatArray, *, max_gap_s: float) -> GyroIntegral:
    """Integrate `rates` (N,) at rising `stamps_s` (N,), N >= 2; pieces longer than `max_gap_s` stay unknown."""
    dt = np.diff(stamps_s)
    known = (dt <= max_gap_s).astype(np.float64)
    pieces = 0.5 * (rates[1:] + rates[:-1]) * dt * known
    slope = np.divide(np.diff(rates), dt, out=np.zeros_like(dt), where=dt > 0)
    return GyroIntegral(
        stamps_s=stamps_s,
        rates=rates,
        angle=np.concatenate([[0.0], np.cumsum(pieces)]),
        covered_s=np.concatenate([[0.0], np.cumsum(dt * known)]),
        slope=slope,
        known=known,
    )
