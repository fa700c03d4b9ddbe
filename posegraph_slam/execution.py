"""How a batch of independent work is run, and how a long stage tells of its progress."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Protocol, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


class Progress(Protocol):
    """Receives `stage`, units done and units in all; called now and then by stages that last."""

    def __call__(self, stage: str, done: int, total: int) -> None: ...


def silent_progress(stage: str, done: int, total: int) -> None:
    """Ignore progress."""


class Executor(Protocol):
    """Runs a top-level function over items; results come in the order of the items, whatever the workers."""

    @property
    def workers(self) -> int: ...

    def map(self, function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]: ...


class SerialExecutor:
    """Run every item in the calling thread."""

    workers = 1

    def map(self, function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
        return [function(item) for item in items]


def split_range(count: int, chunk: int) -> Sequence[tuple[int, int]]:
    """Split range(count) into consecutive (start, stop) pieces of at most `chunk`; independent of the workers."""
    return [(start, min(start + chunk, count)) for start in range(0, count, chunk)]
