"""Summary of a set of errors."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from posegraph_slam.arrays import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorStatistics:
    """Mean, standard deviation (of the population), median, RMSE and maximum of `count` non-negative errors."""

    count: int
    mean: float
    std: float
    median: float
    rmse: float
    max: float

    def as_dict(self) -> dict[str, float | int]:
        """Return the fields for JSON."""
        return asdict(self)


def summarise(errors: FloatArray) -> ErrorStatistics | None:
    """Summarise errors (N,); None when there are none, since nothing can be said then."""
    if len(errors) == 0:
        return None
    return ErrorStatistics(
        count=len(errors),
        mean=float(errors.mean()),
        std=float(errors.std()),
        median=float(np.median(errors)),
        rmse=float(np.sqrt(np.mean(errors**2))),
        max=float(errors.max()),
    )


def optional_dict(statistics: ErrorStatistics | None) -> dict[str, float | int] | None:
    """Return the fields for JSON, or None."""
    return None if statistics is None else statistics.as_dict()
