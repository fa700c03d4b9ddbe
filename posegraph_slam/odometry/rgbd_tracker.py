"""A piece of an RGB-D camera's path: frames aligned to the last keyframe, by features where that fails."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from pydantic import Field

from posegraph_slam.arrays import FloatArray
from posegraph_slam.geometry import SE3
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
    """Once tracking fails, later frames are tracked among each other, and each is still tried against the last place
    known; with more frames than this tracked anew, that place is given up, and the motion from it is guessed."""
    lost_sigma_m: float = Field(default=1.0, gt=0)
    """Deviation of a guessed pose,"""
    lost_sigma_rad: float = Field(default=1.0, gt=0)
    """and of its rotation."""


@dataclass(slots=True)
class RgbdTracker:
    """One piece of the camera's path, tracked without a break: its keyframe, its last frame, and what was found so far.

    `poses` map frames to poses in the piece's first frame; `motions` and `information` belong to the steps between its
    `keyframes`. `T_key_last` is the pose of the last frame in the keyframe.
    """

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

    @classmethod
    def begin_at(cls, k: int, frame: RgbdFrame, settings: RgbdOdometrySettings, seed: int) -> RgbdTracker:
        """Begin a piece at frame k, its first keyframe and the origin of its poses."""
        return cls(
            settings=settings, seed=seed, key=k, reference=prepare_reference(frame), poses={k: np.eye(4)}, last=k,
            frame=frame, step=np.eye(4), T_key_last=np.eye(4), keyframes=[k],
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.poses)

    def depth_m(self) -> float:
        """Median depth of the keyframe's points."""
        return float(np.median(self.reference.points[-1].points[:, 2])) if len(self.reference.points[-1]) else 1.0

    def leaps(self, T_a_b: FloatArray, turn_rad: float, shift: float) -> bool:
        """Whether a motion is larger than a turn or a share of the depth."""
        tangent = SE3.log(T_a_b)
        return bool(np.linalg.norm(tangent[:3]) > turn_rad or np.linalg.norm(T_a_b[:3, 3]) > shift * self.depth_m())

    def find(self, frame: RgbdFrame, k: int) -> RgbdAlignment:
        """Align frame k to the keyframe; where that fails, the last frame becomes the keyframe and is tried too."""
        found = self.align(frame, k)
        if not found.usable and self.last != self.key:
            self.promote(None)
            found = self.align(frame, k)
        return found

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
            self.begin(reference, both.T_target_source, both.information)
        else:  # aligned in one direction only: believed less
            self.begin(reference, self.T_key_last, both.information * 0.1)

    def begin(self, reference: RgbdReference, T: FloatArray, information: FloatArray) -> None:
        """Begin the keyframe of the last frame, at T in the old one."""
        self.motions.append(T)
        self.information.append(information)
        self.key, self.reference, self.features = self.last, reference, {}
        self.keyframes.append(self.key)
        self.T_key_last = np.eye(4)

    def finish(self) -> None:
        """Make the last frame a keyframe, so that the piece ends in a node of the graph."""
        if self.keyframes[-1] != self.last:
            self.promote(None)

    def take_over(self, other: RgbdTracker, k: int, found: RgbdAlignment) -> None:
        """Place the frames of another piece, to whose keyframe frame k of this one is aligned as `found`."""
        T_here_other = self.poses[k] @ SE3.inverse(other.poses[other.key] @ found.T_target_source)
        for frame, pose in other.poses.items():
            self.poses[frame] = T_here_other @ pose


def fit_score(found: RgbdAlignment) -> float:
    """Order alignments of one pair: usable ones first, then by how well surfaces and intensities agree."""
    return 2.0 * found.usable + found.agreement * found.inlier_fraction * max(found.correlation, 0.0)


def features_of(frame: RgbdFrame, most: int) -> Features:
    """Detect up to `most` features of a frame at full resolution."""
    return detect_features(frame.intensity[0], frame.depth[0], frame.camera[0], most=most)
