"""Stamps of the messages of a topic: out of order, never set, jumping back, or of another clock."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.errors import InputError

JUMP_S = 1.0
"""Messages overtake each other by milliseconds; a stamp that lies this far back is a clock that was set."""
OTHER_CLOCK_S = 3600.0


def message_order(
    path: Path, topic: str, stamps_s: FloatArray, recorded_s: FloatArray, remarks: list[str]
) -> tuple[FloatArray, IntArray]:
    """Return the stamps (N,) to use and the order (N,) in which they rise.

    Stamps are those of the headers; where no header was stamped, the times of recording. Raises InputError naming the
    topic where the clock jumps back by more than a second.
    """
    if not stamps_s.any():
        remarks.append(f"the messages of {topic} carry no stamps: the times of their recording are taken")
        stamps_s = recorded_s
    elif abs(float(np.median(stamps_s - recorded_s))) > OTHER_CLOCK_S:
        remarks.append(
            f"the stamps of {topic} are of another clock than the recording's (simulated time?): the stamps are taken"
        )
    back = np.diff(stamps_s)
    if len(back) and back.min() < -JUMP_S:
        k = int(np.argmin(back))
        problem = (
            f"topic {topic}: the clock jumps back by {-back[k]:.3f} s after message {k} "
            f"({stamps_s[k]:.3f} s, then {stamps_s[k + 1]:.3f} s)"
        )
        raise InputError(path, problem, "cut the bag there and read its parts one by one")
    late = int(np.count_nonzero(back < 0))
    if late:
        remarks.append(f"{late} messages of {topic} are out of order and were put in order by their stamps")
    return stamps_s, np.argsort(stamps_s, kind="stable")


def refuse_other_clock(path: Path, role: str, topic: str, stamps_s: FloatArray, scan_stamps_s: FloatArray) -> None:
    """Raise InputError where a stream does not overlap in time with the scans: their clocks differ."""
    if not len(stamps_s) or not len(scan_stamps_s):
        return
    first, last = float(stamps_s.min()), float(stamps_s.max())
    start, end = float(scan_stamps_s.min()), float(scan_stamps_s.max())
    if first > end or last < start:
        problem = f"topic {topic} covers {first:.1f} to {last:.1f} s, the scans {start:.1f} to {end:.1f} s: two clocks"
        remedy = f"record both with one clock (use_sim_time), or leave it out by --topic {role}=none"
        raise InputError(path, problem, remedy)
