"""Motion of an RGB-D camera: pieces tracked without a break, found again where tracking fails, and put together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from posegraph_slam.arrays import BoolArray, FloatArray, IntArray, read_only
from posegraph_slam.errors import InputError
from posegraph_slam.execution import Executor, Progress, SerialExecutor, silent_progress, split_range
from posegraph_slam.geometry import Trajectory, interpolate
from posegraph_slam.odometry.rgbd_tracker import RgbdOdometrySettings, RgbdTracker
from posegraph_slam.registration.rgbd_frame import RgbdFrame

FRAMES_AT_ONCE = 8
"""Frames that are read ahead together."""

FrameSource = Callable[[int], RgbdFrame]
"""Gives frame k of a sequence, read and prepared."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RgbdOdometry:
    """The camera's path, odom -> camera, a pose for every frame, and its keyframes.

    `T_i_j`, `information` (K-1,) are the measured motions between consecutive keyframes; `guessed` (K-1,) marks those
    where tracking was lost and the motion is only a guess; `tracked` (N,) frames that were aligned, the others are
    interpolated. `remarks` are sentences for people.
    """

    trajectory: Trajectory
    keyframes: IntArray
    T_i_j: FloatArray
    information: FloatArray
    guessed: BoolArray
    tracked: BoolArray
    remarks: tuple[str, ...]

    def __post_init__(self) -> None:
        for name, kind in (("keyframes", np.int64), ("T_i_j", float), ("information", float),
                           ("guessed", np.bool_), ("tracked", np.bool_)):  # fmt: skip
            object.__setattr__(self, name, read_only(getattr(self, name), kind))


@dataclass(slots=True)
class _Pieces:
    """The path so far: pieces that were left for good, and those, oldest first, in which the next frame may lie."""

    settings: RgbdOdometrySettings
    seed: int
    left: list[RgbdTracker] = field(default_factory=list)
    open: list[RgbdTracker] = field(default_factory=list)
    problems: dict[int, str] = field(default_factory=dict)
    """Why frames fitted no place that was open to them."""

    def track(self, k: int, frame: RgbdFrame) -> None:
        """Find frame k in the oldest piece that it fits, or begin a new piece with it."""
        for place, piece in enumerate(self.open):
            found = piece.find(frame, k)
            if found.usable:
                piece.accept(k, frame, found)
                self.return_to(place, k, frame)
                break
            self.problems.setdefault(k, found.problem)
        else:
            if len(self.open) > 1 and len(self.open[-1]) == 1:
                self.open.pop()  # neither those before nor this one fit it
            self.open.append(RgbdTracker.begin_at(k, frame, self.settings, self.seed))
        while sum(map(len, self.open[1:])) > self.settings.lost_frames_max:
            self.left.append(self.open.pop(0))

    def return_to(self, place: int, k: int, frame: RgbdFrame) -> None:
        """End the pieces begun since tracking failed in that at `place`: frame k, found there, may tie them to it."""
        for piece in self.open[place + 1 :]:
            found = piece.find(frame, k)
            if found.usable:
                self.open[place].take_over(piece, k, found)
        del self.open[place + 1 :]

    def finished(self) -> list[RgbdTracker]:
        """All pieces of two frames or more in order; InputError where there is none."""
        pieces = [piece for piece in (*self.left, *self.open) if len(piece) > 1]
        if not pieces:
            raise InputError(
                "rgbd",
                f"no frame can be aligned to another ({next(iter(self.problems.values()), '')})",
                "check intrinsics, depth unit, and that the frames overlap",
            )
        for piece in pieces:
            piece.finish()
        return pieces


def track_rgbd(
    frames: FrameSource,
    stamps_s: FloatArray,
    settings: RgbdOdometrySettings,
    *,
    seed: int = 0,
    executor: Executor | None = None,
    progress: Progress = silent_progress,
) -> RgbdOdometry:
    """Track the camera through frames 0 .. N-1 taken at `stamps_s` (N,).

    Frames are read ahead by the executor, a few at a time; the result does not depend on it. Frames that cannot be
    aligned begin a piece of their own, which later ones join, and which is placed as soon as one of them fits the
    piece before as well. Where none does, the motion between pieces is guessed and marked. Raises InputError for fewer
    than two frames, or where no two can be aligned.
    """
    count, executor = len(stamps_s), executor or SerialExecutor()
    if count < 2:
        raise InputError("rgbd", f"{count} frames", "odometry needs two or more")
    pieces = _Pieces(settings=settings, seed=seed)
    pieces.open.append(RgbdTracker.begin_at(0, frames(0), settings, seed))
    for start, stop in split_range(count - 1, FRAMES_AT_ONCE):
        for k, frame in enumerate(executor.map(frames, range(start + 1, stop + 1)), start=start + 1):
            pieces.track(k, frame)
        progress("odometry", stop, count - 1)
    return _result(pieces.finished(), np.asarray(stamps_s, dtype=np.float64), pieces.problems)


def _result(pieces: list[RgbdTracker], stamps_s: FloatArray, problems: dict[int, str]) -> RgbdOdometry:
    """Put pieces one behind the other: each begins where the one before was seen last, which is a guess."""
    s = pieces[0].settings
    guess = np.diag(np.repeat([s.lost_sigma_rad, s.lost_sigma_m], 3) ** -2.0)
    poses, keyframes, T_odom_piece = dict[int, FloatArray](), list[int](), np.eye(4)
    motions, information, guessed = list[FloatArray](), list[FloatArray](), list[bool]()
    for number, piece in enumerate(pieces):
        if number > 0:
            T_odom_piece = poses[keyframes[-1]]
            motions.append(np.eye(4))
            information.append(guess)
            guessed.append(True)
        poses |= {k: T_odom_piece @ T for k, T in piece.poses.items()}
        keyframes += piece.keyframes
        motions += piece.motions
        information += piece.information
        guessed += [False] * len(piece.motions)
    known = np.array(sorted(poses))
    tracked = np.zeros(len(stamps_s), dtype=np.bool_)
    tracked[known] = True
    return RgbdOdometry(
        trajectory=_filled(known, np.stack([poses[int(k)] for k in known]), stamps_s),
        keyframes=np.array(keyframes),
        T_i_j=np.stack(motions),
        information=np.stack(information),
        guessed=np.array(guessed),
        tracked=tracked,
        remarks=_remarks(tracked, np.array(keyframes)[1:][guessed], problems),
    )


def _filled(known: IntArray, poses: FloatArray, stamps_s: FloatArray) -> Trajectory:
    """Interpolate the poses of the frames `known` (n,) over frame numbers, which always rise; the ends are held."""
    between = Trajectory(stamps_s=known.astype(np.float64), poses=poses, parent="odom", child="camera")
    rows = np.clip(np.arange(len(stamps_s), dtype=np.float64), known[0], known[-1])
    filled = interpolate(between, rows).poses.copy()
    filled[known] = poses
    return Trajectory(stamps_s=stamps_s, poses=filled, parent="odom", child="camera")


def _remarks(tracked: BoolArray, after_guess: IntArray, problems: dict[int, str]) -> tuple[str, ...]:
    remarks = []
    lost = int(np.count_nonzero(~tracked))
    if lost:
        first = int(np.argmin(tracked))
        why = f": {problems[first]}" if first in problems else ""  # the first frame of all is no failure by itself
        remarks.append(f"{lost} frames could not be aligned (first frame {first}{why}); their poses are interpolated")
    if len(after_guess):
        at = ", ".join(map(str, after_guess[:5].tolist()))
        remarks.append(f"tracking was lost before frame {at}: the motion there is a guess of odometry")
    return tuple(remarks)
