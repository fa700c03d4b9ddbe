"""Executors that run batches on threads or processes; results come in the order of the items."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor as FuturesExecutor
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from types import TracebackType
from typing import Literal

from posegraph_slam.errors import ConfigurationError
from posegraph_slam.execution import Executor, Item, Result, SerialExecutor

Kind = Literal["threads", "processes"]


class PoolExecutor:
    """Run items on a pool that lives until `close`, or until the end of a `with` block.

    The first exception of an item, in item order, is raised; items not yet started are then dropped.
    """

    def __init__(self, pool: FuturesExecutor, workers: int) -> None:
        self._pool, self._workers = pool, workers

    @property
    def workers(self) -> int:
        """Items that run at the same time."""
        return self._workers

    def map(self, function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
        """Return function(item) of every item, in their order."""
        futures = [self._pool.submit(function, item) for item in items]
        try:
            return [future.result() for future in futures]
        except BaseException:
            for future in futures:
                future.cancel()
            raise

    def close(self) -> None:
        """Wait for running items and release the workers."""
        self._pool.shutdown(wait=True, cancel_futures=True)

    def __enter__(self) -> PoolExecutor:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class ThreadExecutor(PoolExecutor):
    """Threads of this process: for kernels and libraries that release the GIL, with nothing copied."""

    def __init__(self, workers: int) -> None:
        super().__init__(ThreadPoolExecutor(workers, thread_name_prefix="psg"), workers)


class ProcessExecutor(PoolExecutor):
    """Fresh processes (spawn): for work that holds the GIL; functions must be top-level, items arrays and records.

    Spawned rather than forked, since forking a process whose libraries hold threads can deadlock.
    """

    def __init__(self, workers: int) -> None:
        super().__init__(ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")), workers)


def make_executor(workers: int, kind: Kind = "threads") -> SerialExecutor | PoolExecutor:
    """Return an executor with `workers` (at least 1); one worker runs in the calling thread."""
    if workers < 1:
        raise ConfigurationError("workers", f"{workers} is not a number of workers", "it must be an integer >= 1")
    if workers == 1:
        return SerialExecutor()
    return ThreadExecutor(workers) if kind == "threads" else ProcessExecutor(workers)


@contextmanager
def open_executor(workers: int, kind: Kind = "threads") -> Iterator[Executor]:
    """Yield the executor of `make_executor`, and release its workers when the block ends."""
    executor = make_executor(workers, kind)
    try:
        yield executor
    finally:
        if isinstance(executor, PoolExecutor):
            executor.close()
