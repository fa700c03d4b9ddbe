"""From the Hessian of a scan match to the information of a constraint between robot poses."""

from __future__ import annotations

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.geometry import SE2

FREE_INFORMATION = 1e-4
"""Eigenvalue given to a direction that the points leave free: one sigma of 100 m or rad, and still invertible."""


def information_with_floor(hessian: FloatArray, sigma_m: float, sigma_rad: float) -> FloatArray:
    """Return the information (..., 3, 3) of covariance `hessian`^-1 plus a floor for errors that points share."""
    values, vectors = np.linalg.eigh(hessian)
    scaled = vectors / np.maximum(values, FREE_INFORMATION)[..., None, :]
    covariance = scaled @ np.swapaxes(vectors, -1, -2) + np.diag([sigma_m**2, sigma_m**2, sigma_rad**2])
    return inverse(covariance)


def inverse(matrices: FloatArray) -> FloatArray:
    """Invert covariances or information matrices (..., p, p), symmetric to the last bit."""
    result = np.linalg.inv(matrices)
    return np.asarray(0.5 * (result + np.swapaxes(result, -1, -2)), dtype=np.float64)


def information_in_base(information_lidar: FloatArray, T_base_lidar: FloatArray) -> FloatArray:
    """Move information (..., 3, 3) of a relative lidar pose to that of the base that carries the lidar."""
    adjoint = SE2.adjoint(SE2.inverse(T_base_lidar))
    return np.asarray(adjoint.T @ information_lidar @ adjoint)
