"""MATLAB files (version 5 to 7.2) as dictionaries, with errors that name the file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat

from posegraph_slam.arrays import FloatArray
from posegraph_slam.errors import InputError


def load_mat(path: Path) -> dict[str, Any]:
    """Return the variables of a MATLAB file; raise InputError where it cannot be read."""
    try:
        content = dict(loadmat(path, squeeze_me=False))
    except NotImplementedError as error:
        raise InputError(path, "is a MATLAB 7.3 file", "save it in MATLAB by save -v7") from error
    except Exception as error:  # a damaged file fails in every way that a parser can
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        problem = f"cannot be read as a MATLAB file ({reason})"
        raise InputError(path, problem, "the file may be truncated: copy it again") from error
    return {name: value for name, value in content.items() if not name.startswith("__")}


def require(content: dict[str, Any], name: str, path: Path) -> Any:
    """Return the variable `name` of a file's content; raise InputError naming what there is instead."""
    if name not in content:
        raise InputError(path, f"has no field '{name}'", f"it holds {', '.join(content) or 'nothing'}")
    return content[name]


def numbers(value: Any, name: str, path: Path) -> FloatArray:
    """Return a variable or field as float64 of any shape; raise InputError naming it where it holds no numbers."""
    array = np.asarray(value)
    if array.dtype.kind not in "biuf":
        raise InputError(path, f"field '{name}' holds {array.dtype}, not numbers", "store it as a numeric array")
    return np.asarray(array, dtype=np.float64)
