"""Fields of NumPy archives, checked one by one so that every complaint names file and field."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from posegraph_slam.arrays import FloatArray, in_range, range_fault
from posegraph_slam.errors import InputError


class Archive:
    """The numeric fields of one .npz file, read at once; pickled objects are refused."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with np.load(path, allow_pickle=False) as archive:
                self._fields: dict[str, npt.NDArray[Any]] = {name: archive[name] for name in archive.files}
        except Exception as error:  # a damaged archive fails in every way that a parser can
            problem = f"cannot be read as an .npz archive ({_first_line(error)})"
            raise InputError(path, problem, "the file may be truncated: copy or record it again") from error

    def __contains__(self, name: str) -> bool:
        return name in self._fields

    def numbers(self, name: str) -> npt.NDArray[Any]:
        """Return the field, a numeric array of any shape and type."""
        if name not in self._fields:
            present = ", ".join(sorted(self._fields)) or "nothing"
            raise InputError(self.path, f"has no field '{name}'", f"it holds {present}")
        field = self._fields[name]
        if field.dtype.kind not in "iuf":
            raise InputError(self.path, f"field '{name}' is {field.dtype}, not a number", "store it as float or int")
        return field

    def scalar(self, name: str) -> float:
        """Return a field of one finite number, stored with any number of dimensions."""
        field = self.numbers(name)
        if field.size != 1 or not in_range(field).all():
            raise InputError(self.path, f"field '{name}' {field.shape} is not one finite number")
        return float(field.reshape(-1)[0])

    def stamps(self, name: str) -> FloatArray:
        """Return stamps (N,), N > 0, that are finite and never run backwards."""
        stamps = np.asarray(self.numbers(name), dtype=np.float64)
        if stamps.ndim == 2 and 1 in stamps.shape:
            stamps = stamps.reshape(-1)
        if stamps.ndim != 1 or not stamps.size:
            raise InputError(self.path, f"field '{name}' has shape {stamps.shape}", "expected (samples,), not empty")
        self._require_in_range(name, stamps)
        back = np.diff(stamps) < 0
        if back.any():
            k = int(np.argmax(back))
            problem = (
                f"the clock in '{name}' runs backwards at index {k + 1}: {stamps[k]:.6f} s, then {stamps[k + 1]:.6f} s"
            )
            raise InputError(self.path, problem, "repair or cut the log there")
        return stamps

    def samples(self, name: str, rows: int | None, stamps_s: FloatArray) -> npt.NDArray[Any]:
        """Return a field (rows, N) with one column a stamp; `rows` None allows any number of them."""
        field = self.numbers(name)
        if field.ndim != 2 or field.shape[1] != len(stamps_s) or not field.size or rows not in (None, field.shape[0]):
            wanted = f"({'rows' if rows is None else rows}, {len(stamps_s)})"
            raise InputError(
                self.path, f"field '{name}' has shape {field.shape}", f"expected {wanted}: a column a stamp"
            )
        return field

    def finite_samples(self, name: str, rows: int, stamps_s: FloatArray) -> FloatArray:
        """Return a field (rows, N) without NaN or infinity as float64."""
        field = np.asarray(self.samples(name, rows, stamps_s), dtype=np.float64)
        self._require_in_range(name, field)
        return field

    def _require_in_range(self, name: str, values: FloatArray) -> None:
        """Refuse values (..., N) that are not finite or far too large, naming the first index of the last axis."""
        bad = ~in_range(values).reshape(-1, values.shape[-1]).all(axis=0)
        if bad.any():
            k = int(np.argmax(bad))
            raise InputError(self.path, f"field '{name}' is {range_fault(values[..., k])} at index {k}")


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")
