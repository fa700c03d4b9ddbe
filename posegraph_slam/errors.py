"""The errors that a user can cause, each one clear line that says what to do."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from pathlib import Path


class PosegraphSlamError(Exception):
    """Base of every error that the command line reports as one line with exit code 2."""


class InputError(PosegraphSlamError):
    """A file, stream or argument cannot be used as it is.

    `where` names the file, line, field or stream; `problem` what is wrong with it; `remedy` what to do.
    """

    def __init__(self, where: str | Path, problem: str, remedy: str = "") -> None:
        self.where, self.problem, self.remedy = str(where), problem, remedy
        super().__init__(f"{where}: {problem}" + (f"; {remedy}" if remedy else ""))


class ConfigurationError(InputError):
    """A configuration key is unknown, out of range or contradicts another one."""


class GraphError(InputError):
    """A pose graph cannot be solved: disconnected, without gauge, not finite or indefinite."""


def did_you_mean(word: str, known: Iterable[str], *, cutoff: float = 0.5) -> str:
    """Return "did you mean 'X'? " for the known word nearest to one that is not known, nothing where none is near."""
    near = difflib.get_close_matches(word.lower(), list(known), n=1, cutoff=cutoff)
    return f"did you mean '{near[0]}'? " if near else ""
