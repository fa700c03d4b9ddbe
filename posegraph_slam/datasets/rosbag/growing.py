"""Arrays that grow a row at a time while a bag is read."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

CHUNK_BYTES = 1 << 22
"""Rows are collected in blocks of 4 MiB, so that no row is ever moved while the array grows."""


class GrowingRows:
    """Rows of one shape and type, appended one by one."""

    def __init__(self, shape: tuple[int, ...], dtype: npt.DTypeLike = np.float64) -> None:
        self._shape, self._dtype = shape, np.dtype(dtype)
        row_bytes = max(int(np.prod(shape, dtype=np.int64)) * self._dtype.itemsize, 1)
        self._rows_a_chunk = max(CHUNK_BYTES // row_bytes, 1)
        self._chunks: list[npt.NDArray[Any]] = []
        self._length = 0

    def __len__(self) -> int:
        return self._length

    def append(self, row: npt.ArrayLike) -> None:
        """Add one row."""
        at = self._length % self._rows_a_chunk
        if at == 0:
            self._chunks.append(np.empty((self._rows_a_chunk, *self._shape), dtype=self._dtype))
        self._chunks[-1][at] = row
        self._length += 1

    def take(self) -> npt.NDArray[Any]:
        """Return all rows as one array and forget them: blocks are freed as they are copied."""
        result = np.empty((self._length, *self._shape), dtype=self._dtype)
        for start in range(0, self._length, self._rows_a_chunk):
            part = result[start : start + self._rows_a_chunk]
            part[:] = self._chunks.pop(0)[: len(part)]
        self._length = 0
        return result
