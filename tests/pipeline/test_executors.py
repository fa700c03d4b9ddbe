"""Every executor gives the serial result, in item order, and passes errors on."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator

import pytest

from posegraph_slam.errors import ConfigurationError
from posegraph_slam.execution import Executor, SerialExecutor
from posegraph_slam.pipeline.executors import (
    PoolExecutor,
    ProcessExecutor,
    ThreadExecutor,
    make_executor,
    open_executor,
)


@pytest.fixture(params=["serial", "threads", "processes"])
def executor(request: pytest.FixtureRequest) -> Iterator[Executor]:
    if request.param == "serial":
        yield SerialExecutor()
        return
    with ThreadExecutor(2) if request.param == "threads" else ProcessExecutor(2) as pool:
        yield pool


def test_results_come_in_item_order_and_errors_come_through(executor: Executor) -> None:
    values = list(range(40))
    assert executor.map(math.factorial, values) == [math.factorial(value) for value in values]
    assert executor.map(math.factorial, []) == []
    with pytest.raises(ValueError, match="factorial"):
        executor.map(math.factorial, [3, -1, 2])
    assert executor.map(math.factorial, [4]) == [24]


def test_slow_first_item_does_not_reorder() -> None:
    def wait(seconds: float) -> float:
        time.sleep(seconds)
        return seconds

    with ThreadExecutor(3) as pool:
        assert pool.map(wait, [0.05, 0.0, 0.02]) == [0.05, 0.0, 0.02]


def test_threads_run_at_the_same_time() -> None:
    meeting = threading.Barrier(2, timeout=5)
    with ThreadExecutor(2) as pool:
        assert sorted(pool.map(lambda _: meeting.wait(), [0, 1])) == [0, 1]


def test_make_executor() -> None:
    assert isinstance(make_executor(1), SerialExecutor)
    pool = make_executor(3)
    assert isinstance(pool, ThreadExecutor)
    assert pool.workers == 3
    pool.close()
    processes = make_executor(2, "processes")
    assert isinstance(processes, PoolExecutor)
    processes.close()
    with pytest.raises(ConfigurationError, match=">= 1"):
        make_executor(0)


def test_open_executor_releases_its_workers() -> None:
    with open_executor(2) as pool:
        assert pool.map(abs, [-1, 2]) == [1, 2]
    with pytest.raises(RuntimeError, match="shutdown"):
        pool.map(abs, [1])
    with open_executor(1) as serial:
        assert serial.map(abs, [-3]) == [3]
