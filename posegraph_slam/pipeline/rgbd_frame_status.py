"""Which frames of an RGB-D log were aligned, and which of them hang together."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from posegraph_slam.arrays import BoolArray, IntArray, read_only
from posegraph_slam.odometry.rgbd_odometry import RgbdOdometry
from posegraph_slam.pose_graph.checks import component_labels
from posegraph_slam.pose_graph.graph import PoseGraph


class FrameStatus(StrEnum):
    """How the pose of a frame came about."""

    KEYFRAME = "keyframe"
    TRACKED = "tracked"
    INTERPOLATED = "interpolated"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameParts:
    """Parts of an RGB-D log that alignments and loop closures hold together.

    `part` (N,) numbers the part of every frame, -1 for one that was not aligned; `is_key` (N,) marks keyframes. Parts
    are numbered by their frames, the largest is 0; where one lies in another is only guessed.
    """

    part: IntArray
    is_key: BoolArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "part", read_only(self.part, np.int64))
        object.__setattr__(self, "is_key", read_only(self.is_key, np.bool_))

    @property
    def count(self) -> int:
        """Number of parts."""
        return int(self.part.max()) + 1

    @property
    def main(self) -> IntArray:
        """Frames (m,) of the largest part."""
        return np.flatnonzero(self.part == 0)

    def status(self) -> list[FrameStatus]:
        """How the pose of every frame came about."""
        return [
            FrameStatus.INTERPOLATED if part < 0 else FrameStatus.KEYFRAME if key else FrameStatus.TRACKED
            for part, key in zip(self.part.tolist(), self.is_key.tolist(), strict=True)
        ]

    def remarks(self, guesses: int) -> tuple[str, ...]:
        """Say whether all frames hang together in spite of `guesses` motions that are not known, or which do not."""
        if self.count < 2:
            return ("loop closures tie what was tracked before and after it together again",) if guesses else ()
        apart = np.flatnonzero(self.part > 0)
        return (
            f"{len(apart)} frames from {apart[0]} on hang together with no others ({self.count} parts, frames.csv): no "
            f"loop closes to them, their place is a guess, and the cloud leaves them out",
        )


def frame_parts(tracked: RgbdOdometry, graph: PoseGraph) -> FrameParts:
    """Find the parts that measured motions and the loop closures of the solved graph hold together.

    The graph's first K-1 constraints are the motions between keyframes, of which guesses hold nothing together.
    """
    measured = np.ones(len(graph.constraints), dtype=np.bool_)
    measured[: len(tracked.guessed)] = ~tracked.guessed
    label = component_labels(graph.with_constraints(graph.constraints.select(measured)))
    frames = np.arange(len(tracked.tracked))
    # no aligned frame lies between the keyframes on either side of a guess, so that the one before it tells its part
    before = np.clip(np.searchsorted(tracked.keyframes, frames, side="right") - 1, 0, None)
    of_frame = np.where(tracked.tracked, label[before], -1)
    sizes = np.bincount(of_frame[tracked.tracked], minlength=int(label.max()) + 1)
    rank = np.empty(len(sizes), dtype=np.int64)
    rank[np.argsort(-sizes, kind="stable")] = np.arange(len(sizes))
    is_key = np.zeros(len(frames), dtype=np.bool_)
    is_key[tracked.keyframes] = True
    return FrameParts(part=np.where(of_frame < 0, -1, rank[of_frame]), is_key=is_key)
