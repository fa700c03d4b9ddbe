"""Motion of an RGB-D camera: every frame is aligned to the last keyframe, found again by features where that fails."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from pydantic import Field

from posegraph_slam.arrays import BoolArray, FloatArray, IntArray, read_only
from posegraph_slam.errors import InputError
from posegraph_slam.execution import Executor, Progress, SerialExecutor, silent_progress, split_range
from posegraph_slam.geometry import SE3, Trajectory, interpolate
from posegraph_slam.registration.feature_motion import motion_of_matches
from posegraph_slam.registration.features import (
    FEATURES,
    MANY_FEATURES,
    Features,
    detect_features,
    match_features,
)
from posegraph_slam.registration.rgbd_alignment import RgbdAlignment, RgbdAlignmentSettings, align_frames
from posegraph_slam.registration.rgbd_frame import RgbdFrame, RgbdReference, prepare_reference
from posegraph_slam.settings import Settings

FRAMES_AT_ONCE = 8
"""Frames that are read ahead together."""

FrameSource = Callable[[int], RgbdFrame]
"""Gives frame k of a sequence, read and prepared."""


class RgbdOdometrySettings(Settings):
    """How an RGB-D camera is tracked and when a new keyframe begins."""

    alignment: RgbdAlignmentSettings = RgbdAlignmentSettings()
    keyframe_overlap: float = Field(default=0.75, gt=0, le=1)
    """A frame that sees less than this share of its keyframe becomes a keyframe itself,"""
    keyframe_turn_rad: float = Field(default=0.2, gt=0)
    """or one that turned further than this,"""
    keyframe_shift: float = Field(default=0.1, gt=0)
    """or moved further than this share of the median depth."""
    leap_turn_rad: float = Field(default=0.1, gt=0)
    """A frame that turned further than this since the one before,"""
    leap_shift: float = Field(default=0.08, gt=0)
    """or moved further than this share of the median depth, is tried by features as well; the better fit counts."""
    features_min: int = Field(default=15, ge=3)
    """Least number of ORB matches that agree on a motion."""
    lost_frames_max: int = Field(default=10, ge=0)
    """Frames that may be skipped before the camera counts as lost and a new keyframe begins with a guessed pose."""
    lost_sigma_m: float = Field(default=1.0, gt=0)
    """Deviation of a guessed pose,"""
    lost_sigma_rad: float = Field(default=1.0, gt=0)
    """and of its rotation."""


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
class _Tracker:
    """State of tracking: the keyframe, the last aligned frame with its pose in it, and what was found so far."""

    settings: RgbdOdometrySettings
    seed: int
    key: int
    reference: RgbdReference
    poses: dict[int, FloatArray]
    last: int
    frame: RgbdFrame
    step: FloatArray
    """Motion of the camera from frame to frame, for prediction."""
    T_key_last: FloatArray
    features: dict[int, Features] = field(default_factory=dict)
    """Of the keyframe, by how many were looked for."""
    keyframes: list[int] = field(default_factory=list)
    motions: list[FloatArray] = field(default_factory=list)
    information: list[FloatArray] = field(default_factory=list)
    guessed: list[bool] = field(default_factory=list)
    problem: str = ""

    def depth_m(self) -> float:
        """Median depth of the keyframe's points."""
        return float(np.median(self.reference.points[-1].points[:, 2])) if len(self.reference.points[-1]) else 1.0

    def leaps(self, T_a_b: FloatArray, turn_rad: float, shift: float) -> bool:
        """Whether a motion is larger than a turn or a share of the depth."""
        tangent = SE3.log(T_a_b)
        return bool(np.linalg.norm(tangent[:3]) > turn_rad or np.linalg.norm(T_a_b[:3, 3]) > shift * self.depth_m())

    def align(self, frame: RgbdFrame, k: int) -> RgbdAlignment:
        """Align frame k to the keyframe: from the predicted pose, from the last one, then by features."""
        gap = k - self.last
        predicted = self.T_key_last @ SE3.exp(gap * SE3.log(self.step))
        found = align_frames(self.reference, frame, predicted, self.settings.alignment)
        if not found.usable:
            found = align_frames(self.reference, frame, self.T_key_last, self.settings.alignment)
        moved = SE3.between(self.T_key_last, found.T_target_source)
        if found.usable and not self.leaps(moved, self.settings.leap_turn_rad, self.settings.leap_shift):
            return found
        for most in (FEATURES, MANY_FEATURES):
            by_features = self.align_features(frame, most)
            if by_features is not None and fit_score(by_features) > fit_score(found):
                found = by_features
            if found.usable:
                break
        return found

    def align_features(self, frame: RgbdFrame, most: int) -> RgbdAlignment | None:
        """Align a frame from the motion of up to `most` features, None where too few agree."""
        if most not in self.features:
            self.features[most] = features_of(self.reference.frame, most)
        target, source = self.features[most], features_of(frame, most)
        motion = motion_of_matches(
            target, source, match_features(target, source), inliers_min=self.settings.features_min, seed=self.seed
        )
        if not motion.found:
            return None
        return align_frames(self.reference, frame, motion.T_target_source, self.settings.alignment)

    def accept(self, k: int, frame: RgbdFrame, found: RgbdAlignment) -> None:
        """Take over an alignment, and begin a keyframe where the view has changed enough."""
        moved = SE3.between(self.T_key_last, found.T_target_source)
        self.step = SE3.exp(SE3.log(moved) / (k - self.last))
        self.poses[k] = self.poses[self.key] @ found.T_target_source
        self.last, self.frame, self.T_key_last = k, frame, found.T_target_source
        far = self.leaps(found.T_target_source, self.settings.keyframe_turn_rad, self.settings.keyframe_shift)
        if far or found.overlap < self.settings.keyframe_overlap:
            self.promote(found)

    def promote(self, found: RgbdAlignment | None) -> None:
        """Make the last aligned frame the keyframe, its motion measured in both directions."""
        reference = prepare_reference(self.frame)
        both = align_frames(self.reference, reference, self.T_key_last, self.settings.alignment)
        if not both.usable and found is not None:
            both = found
        if both.usable:
            self.poses[self.last] = self.poses[self.key] @ both.T_target_source
            self.begin(reference, both.T_target_source, both.information, guessed=False)
        else:  # aligned in one direction only: believed less
            share = both.information * 0.1
            self.begin(reference, self.T_key_last, share, guessed=False)

    def begin(self, reference: RgbdReference, T: FloatArray, information: FloatArray, *, guessed: bool) -> None:
        """Begin the keyframe of the last frame, at T in the old one."""
        self.motions.append(T)
        self.information.append(information)
        self.guessed.append(guessed)
        self.key, self.reference, self.features = self.last, reference, {}
        self.keyframes.append(self.key)
        self.T_key_last = np.eye(4)

    def restart(self, k: int, frame: RgbdFrame) -> None:
        """Begin a keyframe at frame k with a guessed pose: the camera stands where it was seen last."""
        s = self.settings
        sigma = np.repeat([s.lost_sigma_rad, s.lost_sigma_m], 3)
        T = self.T_key_last
        self.last, self.frame, self.step = k, frame, np.eye(4)
        self.poses[k] = self.poses[self.key] @ T
        self.begin(prepare_reference(frame), T, np.diag(sigma**-2.0), guessed=True)


def fit_score(found: RgbdAlignment) -> float:
    """Order alignments of one pair: usable ones first, then by how well surfaces and intensities agree."""
    return 2.0 * found.usable + found.agreement * found.inlier_fraction * max(found.correlation, 0.0)


def features_of(frame: RgbdFrame, most: int) -> Features:
    """Detect up to `most` features of a frame at full resolution."""
    return detect_features(frame.intensity[0], frame.depth[0], frame.camera[0], most=most)


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
    aligned are skipped; after too many the pose is guessed, marked, and tracking begins anew. Raises InputError for
    fewer than two frames, or where no two can be aligned.
    """
    count, executor = len(stamps_s), executor or SerialExecutor()
    if count < 2:
        raise InputError("rgbd", f"{count} frames", "odometry needs two or more")
    first = frames(0)
    tracker = _Tracker(
        settings=settings, seed=seed, key=0, reference=prepare_reference(first), poses={0: np.eye(4)}, last=0,
        frame=first, step=np.eye(4), T_key_last=np.eye(4), keyframes=[0],
    )  # fmt: skip
    for start, stop in split_range(count - 1, FRAMES_AT_ONCE):
        for k, frame in enumerate(executor.map(frames, range(start + 1, stop + 1)), start=start + 1):
            _track_one(tracker, k, frame)
        progress("odometry", stop, count - 1)
    if tracker.keyframes[-1] != tracker.last:
        tracker.promote(None)
    return _result(tracker, np.asarray(stamps_s, dtype=np.float64))


def _track_one(tracker: _Tracker, k: int, frame: RgbdFrame) -> None:
    found = tracker.align(frame, k)
    if not found.usable and tracker.last != tracker.key:
        tracker.promote(None)
        found = tracker.align(frame, k)
    if found.usable:
        tracker.accept(k, frame, found)
        return
    tracker.problem = tracker.problem or found.problem
    if k - tracker.last > tracker.settings.lost_frames_max:
        tracker.restart(k, frame)


def _result(tracker: _Tracker, stamps_s: FloatArray) -> RgbdOdometry:
    if not tracker.motions or all(tracker.guessed):
        raise InputError(
            "rgbd",
            f"no frame can be aligned to another ({tracker.problem})",
            "check intrinsics, depth unit, and that the frames overlap",
        )
    count, known = len(stamps_s), np.array(sorted(tracker.poses))
    tracked = np.zeros(count, dtype=np.bool_)
    tracked[known] = True
    poses = np.stack([tracker.poses[int(k)] for k in known])
    # frames between are interpolated over their numbers, which always rise
    between = Trajectory(stamps_s=known.astype(np.float64), poses=poses, parent="odom", child="camera")
    poses = interpolate(between, np.arange(count, dtype=np.float64)).poses.copy()
    poses[known] = between.poses
    guessed = np.array(tracker.guessed)
    return RgbdOdometry(
        trajectory=Trajectory(stamps_s=stamps_s, poses=poses, parent="odom", child="camera"),
        keyframes=np.array(tracker.keyframes),
        T_i_j=np.stack(tracker.motions),
        information=np.stack(tracker.information),
        guessed=guessed,
        tracked=tracked,
        remarks=_remarks(tracked, guessed, tracker),
    )


def _remarks(tracked: BoolArray, guessed: BoolArray, tracker: _Tracker) -> tuple[str, ...]:
    remarks = []
    lost = int(np.count_nonzero(~tracked))
    if lost:
        first = int(np.argmin(tracked))
        remarks.append(
            f"{lost} frames could not be aligned (first frame {first}: {tracker.problem}); their poses are interpolated"
        )
    if guessed.any():
        at = ", ".join(str(tracker.keyframes[k + 1]) for k in np.flatnonzero(guessed)[:5])
        remarks.append(f"tracking was lost before frame {at}: the motion there is a guess until a loop closes over it")
    return tuple(remarks)
