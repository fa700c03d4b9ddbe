"""Information matrices through named constructors, so that no bare matrix can be misread as a covariance."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from posegraph_slam.arrays import FloatArray
from posegraph_slam.errors import InputError
from posegraph_slam.geometry import Group

SYMMETRY_TOLERANCE = 1e-9
"""Largest allowed |M - M^T| relative to the largest entry; files print six digits, but both halves from one number."""


def information_from_sigmas(sigmas: npt.ArrayLike) -> FloatArray:
    """Turn standard deviations (..., p) in tangent order and SI units into diagonal information (..., p, p).

    Raises `InputError` unless every deviation is positive and finite.
    """
    sigma = np.asarray(sigmas, dtype=np.float64)
    if sigma.ndim < 1 or not (np.all(np.isfinite(sigma)) and np.all(sigma > 0)):
        raise InputError("noise", "standard deviations must be positive and finite", "give one per tangent direction")
    return sigma[..., None] ** -2.0 * np.eye(sigma.shape[-1])


def information_from_covariance(covariance: npt.ArrayLike) -> FloatArray:
    """Invert covariances (..., p, p) into information (..., p, p), symmetric to the last bit.

    Raises `InputError` unless every covariance is finite, symmetric and positive definite.
    """
    matrix = np.asarray(covariance, dtype=np.float64)
    if matrix.ndim < 2 or matrix.shape[-1] != matrix.shape[-2]:
        raise InputError("noise", f"covariance has shape {matrix.shape}", "give square matrices (..., p, p)")
    if not np.all(np.isfinite(matrix)):
        raise InputError("noise", "covariance is not finite")
    if np.any(asymmetry(matrix) > SYMMETRY_TOLERANCE):
        raise InputError("noise", "covariance is not symmetric", "average it with its transpose if that is meant")
    try:
        L = np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        raise InputError("noise", "covariance is not positive definite", "add a floor to its eigenvalues") from None
    L_inverse = np.linalg.inv(L)
    return symmetrised(np.swapaxes(L_inverse, -1, -2) @ L_inverse)


def information_isotropic(group: Group, *, sigma_translation_m: float, sigma_rotation_rad: float) -> FloatArray:
    """Return the information (p, p) of equal translation deviations and equal rotation deviations.

    The tangent order of `group` is applied here: SE(2) [x, y, theta], SE(3) [rotation, translation].
    """
    translation = [sigma_translation_m] * group.dimension
    rotation = [sigma_rotation_rad] * (group.dof - group.dimension)
    return information_from_sigmas(translation + rotation if group.dimension == 2 else rotation + translation)


def symmetrised(matrix: FloatArray) -> FloatArray:
    """Return the symmetric part of stacked matrices."""
    return np.asarray(0.5 * (matrix + np.swapaxes(matrix, -1, -2)))


def asymmetry(matrix: FloatArray) -> FloatArray:
    """Return max |M - M^T| over max |M| for each of the stacked matrices, 0 where M is zero."""
    scale = np.max(np.abs(matrix), axis=(-2, -1))
    difference = np.max(np.abs(matrix - np.swapaxes(matrix, -1, -2)), axis=(-2, -1))
    return np.asarray(difference / np.where(scale > 0, scale, 1.0))
