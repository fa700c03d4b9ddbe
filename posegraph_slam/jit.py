"""Numba decorators with one set of options, typed for strict checking.

Kernels are compiled on first use and cached beside their source (`NUMBA_CACHE_DIR` moves the cache). They release
the GIL, so that several threads can run chunks of one batch; no kernel uses fast-math, so results are reproducible.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar, cast

import numba
from numba.core import event

F = TypeVar("F", bound=Callable[..., Any])


def kernel(function: F) -> F:
    """Compile a numeric kernel in nopython mode, cached on disk, releasing the GIL."""
    return cast(F, numba.njit(cache=True, nogil=True, error_model="numpy")(function))


def inline_kernel(function: F) -> F:
    """Compile a small kernel that is inlined into the kernels that call it."""
    return cast(F, numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")(function))


@dataclass(slots=True)
class CompileTime:
    """Seconds that numba spent compiling (loading from the cache does not count)."""

    seconds: float = 0.0


@contextmanager
def measure_compile_time() -> Iterator[CompileTime]:
    """Record into the yielded `CompileTime` how long kernels compile inside the block."""
    result = CompileTime()
    with event.install_recorder("numba:compile") as recorder:
        yield result
    depth, started = 0, 0.0
    for stamp, happening in recorder.buffer:
        if happening.is_start:
            started = stamp if depth == 0 else started
            depth += 1
        elif happening.is_end:
            depth -= 1
            result.seconds += stamp - started if depth == 0 else 0.0
