"""The forms of `run.json` and `metrics.json`: the types of what is read back of them, so that a fault names its key."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, NonNegativeInt, ValidationError

from posegraph_slam.errors import InputError

REMEDY = "run `psg optimize` again to write it"
Seconds = Annotated[FiniteFloat, Field(ge=0)]


class Form(BaseModel):
    """A part of a file: keys that are not named here may hold anything, and every key may be missing."""

    model_config = ConfigDict(extra="allow", strict=True, frozen=True)


class InputForm(Form):
    """The log that a run read."""

    path: str | None = None
    format: str | None = None
    sha256: str | None = None
    topics: Mapping[str, str] | None = None


class RecordForm(Form):
    """`run.json`."""

    format_version: int | None = None
    command: list[str] | None = None
    input: InputForm | None = None
    edits: Mapping[str, Any] | None = None
    packages: Mapping[str, str | None] | None = None
    stages_s: Mapping[str, Seconds] | None = None
    total_s: Seconds | None = None
    jit_compile_s: Seconds | None = None
    peak_memory_mib: Seconds | None = None


class RowForm(Form):
    """A row of the comparison of the stages."""

    metric: str
    unit: str
    decimals: int = Field(default=3, ge=0, le=17)
    values: Mapping[str, FiniteFloat | None] = Field(min_length=1)


class TableForm(Form):
    """The comparison of the stages."""

    stages: list[str] | None = None
    rows: list[RowForm] | None = None


class PathForm(Form):
    """What is said of the path of a stage."""

    length_m: FiniteFloat | None = None


class StageForm(Form):
    """The metrics of a stage."""

    path: PathForm | None = None


class MetricsForm(Form):
    """`metrics.json`."""

    table: TableForm | None = None
    stages: Mapping[str, StageForm] | None = None
    remarks: list[str] | None = None
    warnings: list[str] | None = None
    loops_proposed: NonNegativeInt | None = None
    loops_accepted: NonNegativeInt | None = None
    keyframes: NonNegativeInt | None = None
    scans: NonNegativeInt | None = None
    scans_searched: NonNegativeInt | None = None


def read_form(path: Path, form: type[Form]) -> dict[str, Any]:
    """Read the JSON object of a file, without the keys that are null; raise InputError naming the key that is wrong."""
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise InputError(path, f"is not valid JSON: {error}", REMEDY) from error
    if not isinstance(value, dict):
        raise InputError(path, "does not hold a JSON object", REMEDY)
    try:
        form.model_validate(value)
    except ValidationError as error:
        fault = error.errors()[0]
        key = ".".join(map(str, fault["loc"]))
        raise InputError(path, f"'{key}' cannot be used: {fault['msg'].lower()}", REMEDY) from error
    return {name: item for name, item in value.items() if item is not None}
