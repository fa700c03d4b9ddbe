"""The comparison of the stages of a run: one row a metric, one column a stage."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparisonRow:
    """One metric of every stage, None where a stage has none; `decimals` are for printing only."""

    name: str
    unit: str
    values: tuple[float | None, ...]
    decimals: int = 3

    @property
    def label(self) -> str:
        """Name with its unit."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparisonTable:
    """Rows of metrics over the columns `stages`; metrics that no stage has are left out."""

    stages: tuple[str, ...]
    rows: tuple[ComparisonRow, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return the table for JSON: the stages, and by metric its unit, printed decimals and value of each stage."""
        return {
            "stages": list(self.stages),
            "rows": [
                {
                    "metric": row.name,
                    "unit": row.unit,
                    "decimals": row.decimals,
                    "values": dict(zip(self.stages, row.values, strict=True)),
                }
                for row in self.rows
            ],
        }

    def as_text_rows(self) -> list[list[str]]:
        """Return the cells for printing, the header first; a missing value is a dash."""
        header = ["", *self.stages]
        return [header, *([row.label, *(_cell(value, row.decimals) for value in row.values)] for row in self.rows)]


def _cell(value: float | None, decimals: int) -> str:
    return "–" if value is None else f"{value:.{decimals}f}"
