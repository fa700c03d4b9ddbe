"""The edits of a person to the closures of a run: a list that replays, kept in a text file.

An edit names the two keyframes by their scans, and a proposed closure carries its measurement: the same edits give the
same bytes wherever they are applied, and they fit every run of the same log with the same keyframes.
"""

from __future__ import annotations

import hashlib
import tomllib
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from pydantic import Field, ValidationError, model_validator

from posegraph_slam.arrays import FloatArray
from posegraph_slam.errors import InputError
from posegraph_slam.files import replacing
from posegraph_slam.geometry import pose_from_xyt, xyt_from_pose
from posegraph_slam.loop_closure.manual import Proposal
from posegraph_slam.settings import Settings

BYTES_MAX = 1 << 24
"""Larger files are no list of edits made by hand."""


class MeasuredClosure(Settings):
    """A proposed closure as it was registered: base pose of the source in the target, information, evidence."""

    T_target_source: tuple[float, float, float]
    """x (m), y (m) and heading (rad)."""
    information: tuple[float, float, float, float, float, float]
    """Upper triangle, row by row: xx xy xt yy yt tt."""
    travel_m: float = Field(ge=0)
    reach_m: float = Field(ge=0)
    score: float
    matched_fraction: float
    agreement: float
    overlap: float
    rmse_m: float = Field(ge=0)
    error_before_m: float = Field(ge=0)
    error_before_rad: float = Field(ge=0)
    sigmas_before: float = Field(ge=0)

    @model_validator(mode="after")
    def _is_positive(self) -> Self:
        if np.linalg.eigvalsh(information_matrix(self))[0] <= 0:
            raise ValueError("information is not positive definite")
        return self


class Edit(Settings):
    """One change: a pair of keyframes, named by their scans, whose closure is switched off or on, or added."""

    action: Literal["off", "on", "add"]
    target_scan: int = Field(ge=0)
    source_scan: int = Field(ge=0)
    closure: MeasuredClosure | None = None

    @model_validator(mode="after")
    def _is_whole(self) -> Self:
        if (self.closure is not None) != (self.action == "add"):
            raise ValueError("an edit 'add', and no other, has a closure")
        return self

    @property
    def pair(self) -> tuple[int, int]:
        """Target and source scan."""
        return self.target_scan, self.source_scan


class Edits(Settings):
    """The edits of a run in the order in which they were made; `log_sha256` is that of its log, if known."""

    format_version: Literal[1] = 1
    log_sha256: str | None = None
    edit: tuple[Edit, ...] = ()

    def __len__(self) -> int:
        return len(self.edit)


def information_matrix(closure: MeasuredClosure) -> FloatArray:
    """Return the information (3, 3) of a measured closure."""
    upper = np.zeros((3, 3))
    upper[np.triu_indices(3)] = closure.information
    return np.asarray(upper + np.triu(upper, 1).T)


def pose_matrix(closure: MeasuredClosure) -> FloatArray:
    """Return T_target_source (3, 3) of a measured closure."""
    return pose_from_xyt(np.array(closure.T_target_source))


def added(proposal: Proposal, target_scan: int, source_scan: int) -> Edit:
    """Return the edit that adds a registered closure."""
    evidence = {name: getattr(proposal.record, name) for name in EVIDENCE}
    closure = MeasuredClosure(
        T_target_source=tuple(xyt_from_pose(proposal.T_target_source).tolist()),
        information=tuple(proposal.information[np.triu_indices(3)].tolist()),
        **evidence,
    )
    return Edit(action="add", target_scan=target_scan, source_scan=source_scan, closure=closure)


EVIDENCE = tuple(name for name in MeasuredClosure.model_fields if name not in ("T_target_source", "information"))


def to_text(edits: Edits) -> str:
    """Write edits as TOML, every number with the digits that restore it."""
    lines = ["# Closures edited by hand; replay with: psg optimize RUN --from graph --edits THIS_FILE"]
    lines.append(f"format_version = {edits.format_version}")
    if edits.log_sha256 is not None:
        lines.append(f'log_sha256 = "{edits.log_sha256}"')
    for edit in edits.edit:
        lines += ["", "[[edit]]", f'action = "{edit.action}"']
        lines += [f"target_scan = {edit.target_scan}", f"source_scan = {edit.source_scan}"]
        if edit.closure is not None:
            lines.append("[edit.closure]")
            lines += [f"{name} = {_number(value)}" for name, value in edit.closure]
    return "\n".join(lines) + "\n"


def _number(value: Any) -> str:
    return f"[{', '.join(map(_number, value))}]" if isinstance(value, tuple) else repr(float(value))


def write_edits(edits: Edits, path: Path) -> None:
    """Write the file of edits, whole or not at all; without any edit the file goes."""
    if not edits.edit:
        path.unlink(missing_ok=True)
        return
    with replacing(path) as temporary:
        temporary.write_text(to_text(edits), encoding="utf-8", newline="\n")


def read_edits(path: Path) -> Edits:
    """Read a file of edits; raise InputError naming the entry that is wrong."""
    try:
        if path.stat().st_size > BYTES_MAX:
            raise InputError(path, f"is larger than {BYTES_MAX >> 20} MiB", "give a file that psg edit wrote")
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise InputError(path, f"is not valid TOML: {error}") from error
    try:
        return Edits.model_validate(values)
    except ValidationError as error:
        fault = error.errors()[0]
        place = " ".join(f"{part + 1}" if isinstance(part, int) else part for part in fault["loc"]) or "file"
        raise InputError(path, f"{place}: {fault['msg']}", "see docs/commands/edit.md for the format") from error


def edits_digest(edits: Edits) -> str:
    """Return the SHA-256 of the edits as they are written."""
    return hashlib.sha256(to_text(edits).encode()).hexdigest()
