"""Writing files so that a reader never sees half of one."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from posegraph_slam.errors import InputError

NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Errors of writing, which the system reports without a name."""


def name_target(error: OSError, temporary: Path, path: Path) -> None:
    """Make an error of writing `temporary`, a file or folder, name `path`, which was asked for."""
    name, start = str(error.filename or ""), str(temporary)
    if name.startswith(start):
        error.filename, error.filename2 = f"{path}{name[len(start) :]}", None
    elif not name and error.errno in NO_SPACE:
        error.filename = str(path)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`, with its suffix; move it over `path` when the block ends well.

    If the block raises, the temporary file is removed and `path` stays as it was. Missing folders are made. Raises
    InputError where `path` is a folder; errors of the system name `path`, not the temporary file.
    """
    if not path.name or path.is_dir():
        raise InputError(path, "is a folder", "name a file")
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        name_target(error, temporary, path)
        raise
    finally:
        temporary.unlink(missing_ok=True)
