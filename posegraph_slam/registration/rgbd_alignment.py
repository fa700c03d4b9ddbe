"""Direct alignment of two RGB-D frames by intensity and by point-to-plane distance, coarse to fine.

The residuals are those of Steinbruecker et al. 2011 (a point keeps its brightness) and of KinectFusion's tracking
(Newcombe et al. 2011: projective association, distance to the plane at the reference point). Each kind is divided by
its robust deviation, so that their relative weight is measured on every pair and not chosen; Cauchy's weights, close to
the t-distribution of Kerl et al. 2013, hold down what moves, is hidden or reflects.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from pydantic import Field

from posegraph_slam.arrays import FloatArray, read_only
from posegraph_slam.registration.result import RegistrationStatus
from posegraph_slam.registration.rgbd_frame import ReferencePoints, RgbdFrame, RgbdReference
from posegraph_slam.registration.rgbd_kernels import (
    TILES,
    adjoint,
    align_level,
    describe_fit,
    inverse,
    offset_sigma,
    source_update,
)
from posegraph_slam.registration.rgbd_warp import Side
from posegraph_slam.settings import Settings

LEAST_POINTS = 100


class RgbdAlignmentSettings(Settings):
    """How two RGB-D frames are aligned, and when the result is believed."""

    gate_m: float = Field(default=0.06, gt=0)
    """Depths further apart than this on the finest level are no match; it doubles from level to level."""
    iterations_max: int = Field(default=30, ge=1)
    """Gauss-Newton steps on a level."""
    finest_level: int = Field(default=0, ge=0, le=3)
    """Level on which alignment ends: 0 is full resolution; 1 is faster and hardly worse on noisy depth."""
    least_depth_sigma: float = Field(default=0.3, gt=0)
    """Depth is never taken to be better than this share of the sensor's deviation,"""
    least_brightness_sigma: float = Field(default=2.0, gt=0)
    """nor brightness than this, of 255."""
    image_noise: float = Field(default=1.0, gt=0)
    """Noise of brightness, of 255, where depth is exact. Brightness that the uncertainty of depth changes by more, as
    it does where the camera moved across an edge, counts for less; a large value lets all count alike."""
    inverse_depth_sigma: float = Field(default=0.0015, ge=0)
    """Deviation (1/m) of the sensor's smooth error of inverse depth between two views half an image's width apart; it
    is less for closer views, and estimated with the motion. 0 trusts the sensor's calibration. A structured-light
    sensor tells disparities in steps of 0.003."""
    overlap_min: float = Field(default=0.2, ge=0, le=1)
    """Least share of the points that the other frame sees, the larger of both directions."""
    agreement_min: float = Field(default=0.8, ge=0, le=1)
    """Least share of points on the other frame's surface among those not hidden behind it."""
    inlier_fraction_min: float = Field(default=0.5, ge=0, le=1)
    """Least share of the points on a surface that lie within three deviations of it."""
    correlation_min: float = Field(default=0.35, ge=-1, le=1)
    """Least correlation of the intensities of the two frames: surfaces that fit must look alike too."""
    sigma_max_m: float = Field(default=0.15, gt=0)
    """An alignment that leaves a direction less certain than this is degenerate."""
    sigma_floor_m: float = Field(default=0.001, gt=0)
    """No alignment is better known than this,"""
    sigma_floor_rad: float = Field(default=0.0005, gt=0)
    """nor than this: calibration and exposure time err alike in all pixels,"""
    sigma_share: float = Field(default=0.005, ge=0)
    """nor than this share of the motion itself."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RgbdAlignment:
    """T_target_source (4, 4) with its evidence; meaningless unless `usable`.

    `information` (6, 6) is in the tangent of the right update T exp(d), [rotation, translation]. `overlap` is the
    share of points that the other frame sees, `agreement` the share on its surface among those not hidden,
    `inlier_fraction` of those within three deviations, `rmse_m` of these, `correlation` of the intensities.
    `inverse_depth_offsets` (3,) in 1/m are what the source's inverse depth is found to err by against the target's:
    a + b x/z + c y/z on the target's rays. `problem` says why it is not usable.
    """

    T_target_source: FloatArray
    information: FloatArray
    status: RegistrationStatus
    iterations: int
    overlap: float = 0.0
    agreement: float = 0.0
    inlier_fraction: float = 0.0
    rmse_m: float = float("nan")
    correlation: float = 0.0
    inverse_depth_offsets: FloatArray = field(default_factory=lambda: np.zeros(3))
    problem: str = ""

    def __post_init__(self) -> None:
        for name in ("T_target_source", "information", "inverse_depth_offsets"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    @property
    def usable(self) -> bool:
        """Whether the transform may be used."""
        return self.status in (RegistrationStatus.CONVERGED, RegistrationStatus.MAX_ITERATIONS)


def align_frames(
    target: RgbdReference,
    source: RgbdFrame | RgbdReference,
    T_target_source: FloatArray,
    settings: RgbdAlignmentSettings,
) -> RgbdAlignment:
    """Align `source` to `target` from a guess T_target_source (4, 4).

    A source that is a reference too is aligned in both directions at once, which halves what occlusion and gradients
    of one side bias. Where the evidence is poor the result has a status and a `problem`, never an identity pose.
    """
    back = source if isinstance(source, RgbdReference) else None
    frame = source.frame if isinstance(source, RgbdReference) else source
    T, made, settled = np.array(T_target_source, dtype=np.float64), 0, False
    floors, offsets = _floors(settings), np.zeros(3)
    levels = min(frame.levels, target.frame.levels)
    finest = min(settings.finest_level, levels - 1)
    for level in range(levels - 1, finest - 1, -1):
        if len(target.points[level]) < LEAST_POINTS:
            continue
        gate = settings.gate_m * 2.0 ** (level - finest)
        other = _NO_POINTS if back is None else back.points[level]
        side, other_side = _side(target, frame, level), _against(other, target.frame, level)
        T, done, settled = align_level(side, other_side, T, offsets, gate, settings.iterations_max, floors)
        made += done
    return _described(target, frame, back, T, offsets, made, settled, finest, settings)


def _floors(settings: RgbdAlignmentSettings) -> FloatArray:
    """Deviations (4,) that the kernels take: the least ones of depth and brightness, of the offsets, and of noise."""
    s = settings
    return np.array([s.least_depth_sigma, s.least_brightness_sigma, s.inverse_depth_sigma, s.image_noise])


def _side(reference: RgbdReference, frame: RgbdFrame, level: int) -> Side:
    """Points of a reference against the images of another frame."""
    return _against(reference.points[level], frame, level)


def _against(p: ReferencePoints, frame: RgbdFrame, level: int) -> Side:
    return Side(p.points, p.normals, p.gradients, p.intensity, p.sigma_m,
                frame.intensity[level], frame.depth[level], frame.camera[level])  # fmt: skip


_NONE = np.zeros((0, 3))
_NO_POINTS = ReferencePoints(
    points=_NONE, normals=_NONE, gradients=_NONE, intensity=np.zeros(0), sigma_m=np.zeros(0)
)  # fmt: skip


def _described(
    target: RgbdReference, frame: RgbdFrame, back: RgbdReference | None, T: FloatArray, offsets: FloatArray, made: int,
    settled: bool, level: int, settings: RgbdAlignmentSettings,
) -> RgbdAlignment:  # fmt: skip
    """Measure the fit at T on one level and judge it."""
    floors, gate = _floors(settings), settings.gate_m
    H, M, measures = describe_fit(_side(target, frame, level), T, False, offsets, gate, floors)
    all_measures = [measures]
    if back is not None:
        T_back = inverse(T)
        other = _side(back, target.frame, level)
        H_back, M_back, measures = describe_fit(other, T_back, True, offsets, gate, floors)
        A = source_update(T_back, len(H))
        H, M = H + A.T @ H_back @ A, 2 * (M + A.T @ M_back @ A)  # both directions see the same surfaces
        all_measures.append(measures)
    # from the left update exp(e) T to the right one T exp(d): e = Ad(T) d
    A = np.eye(len(H))
    A[:6, :6] = adjoint(T)
    m = np.array(all_measures)
    total = m.sum(axis=0)
    sigma = offset_sigma(_side(target, frame, level), T, settings.inverse_depth_sigma) if len(H) > 6 else 0.0
    information, weakest_m = _information(A.T @ H @ A, A.T @ M @ A, T, float(total[6]), sigma, settings)
    in_view = (m[:, 2:6].sum(axis=1)) / np.maximum(m[:, 0], 1)
    overlap = float(in_view.max())
    agreement = float(total[3] / max(total[3] + total[5], 1))
    fraction = float(total[7] / max(total[6], 1))
    correlation = float(m[:, 9].min())
    problem, status = "", RegistrationStatus.CONVERGED if settled else RegistrationStatus.MAX_ITERATIONS
    if total[0] < LEAST_POINTS:
        status, problem = RegistrationStatus.TOO_FEW_POINTS, f"{int(total[0])} points with depth"
    elif overlap < settings.overlap_min:
        status, problem = RegistrationStatus.TOO_FEW_INLIERS, f"too little overlap: {overlap:.2f}"
    elif total[6] < LEAST_POINTS:
        status, problem = RegistrationStatus.TOO_FEW_INLIERS, f"{int(total[6])} points find depth in the other frame"
    elif agreement < settings.agreement_min:
        status, problem = RegistrationStatus.TOO_FEW_INLIERS, f"surfaces in free space: agreement {agreement:.2f}"
    elif fraction < settings.inlier_fraction_min:
        status, problem = RegistrationStatus.TOO_FEW_INLIERS, f"too few points fit: {fraction:.2f}"
    elif correlation < settings.correlation_min:
        status, problem = RegistrationStatus.TOO_FEW_INLIERS, f"looks different: correlation {correlation:.2f}"
    elif not weakest_m < settings.sigma_max_m:
        status, problem = RegistrationStatus.DEGENERATE, f"a direction is only known to {weakest_m:.2f} m"
    return RgbdAlignment(
        T_target_source=T, information=information, status=status, iterations=made, overlap=overlap,
        agreement=agreement, inlier_fraction=fraction, rmse_m=float(np.sqrt(total[8] / max(total[7], 1))),
        correlation=correlation, inverse_depth_offsets=offsets, problem=problem,
    )  # fmt: skip


def _information(
    H: FloatArray, M: FloatArray, T: FloatArray, points: float, sigma: float, settings: RgbdAlignmentSettings
) -> tuple[FloatArray, float]:
    """Information (6, 6) and the deviation (m) of the weakest direction, turns counted at one metre.

    The covariance is H^-1 M H^-1 (Huber 1967) with M summed over tiles (Liang and Zeger 1986), plus floors; that of the
    offsets of depth, known to `sigma` beforehand, is part of it. Residuals that vanish, on a blank wall, would make it
    small where nothing is known: the weakest direction is judged by H too, with each tile as one measurement.
    """
    scale = float(np.trace(H[:6, :6])) / 6
    if not (np.isfinite(H).all() and np.isfinite(M).all() and scale > 0):
        return np.eye(6) * 1e-6, np.inf
    ridge, prior = np.full(len(H), 1e-9 * scale), np.zeros(len(H))
    prior[6:] = sigma**-2.0 if len(H) > 6 else 0.0
    a_tile = max(points / TILES**2, 1.0)  # the prior counts as much as a tile, in the alignment too
    inverse_H = np.linalg.inv(H + np.diag(ridge + a_tile * prior))
    covariance = (inverse_H @ (M + np.diag(a_tile**2 * prior)) @ inverse_H)[:6, :6]
    cosine = np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1)
    turn, shift = float(np.arccos(cosine)), float(np.linalg.norm(T[:3, 3]))
    floor = np.repeat([settings.sigma_floor_rad + settings.sigma_share * turn,
                       settings.sigma_floor_m + settings.sigma_share * shift], 3) ** 2  # fmt: skip
    covariance = 0.5 * (covariance + covariance.T) + np.diag(floor)
    known = np.linalg.inv((H + np.diag(ridge)) / a_tile + np.diag(prior))[:6, :6]
    weakest = float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], np.linalg.eigvalsh(0.5 * (known + known.T))[-1])))
    information = np.linalg.inv(covariance)
    return 0.5 * (information + information.T), weakest
