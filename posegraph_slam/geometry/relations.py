"""Relative poses between stamps that are known to be true (Kuemmerle et al. 2009)."""

from __future__ import annotations

from dataclasses import dataclass

from posegraph_slam.arrays import FloatArray, read_only


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Relations:
    """Pose T_1_2 (M, 4, 4) of the body at `stamps_2_s` (M,) in its frame at `stamps_1_s` (M,)."""

    stamps_1_s: FloatArray
    stamps_2_s: FloatArray
    T_1_2: FloatArray

    def __post_init__(self) -> None:
        for name in ("stamps_1_s", "stamps_2_s", "T_1_2"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def __len__(self) -> int:
        return int(self.stamps_1_s.shape[0])
