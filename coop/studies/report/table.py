"""A table of results, and its formats CSV, Markdown and HTML."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import pandas as pd

Value = str | int | float | None  # None: the number does not exist


@dataclass(frozen=True)
class ResultTable:
    """A table; `name`: of its files. `note`: what a reader must know about it.

    spreads: columns that readers see beside others, by the column whose value they follow: one in parentheses, a
    deviation; two in brackets, the bounds of an interval. aside: columns that only the CSV has.
    """

    name: str
    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Value]]
    note: str = ""
    spreads: Mapping[str, Sequence[str]] = field(default_factory=dict)
    aside: Sequence[str] = ()

    @cached_property
    def frame(self) -> pd.DataFrame:
        """The table with its values as they are."""
        return pd.DataFrame(self.rows, columns=list(self.columns), dtype=object)

    def csv(self) -> str:
        """The table as CSV, with ten significant digits; a missing number is empty."""
        text: str = self.frame.map(_exact).to_csv(index=False, lineterminator="\n")
        return text

    def readable(self) -> pd.DataFrame:
        """The table as text for readers, rounded, with deviations and intervals beside their values."""
        shown = self.frame.map(rounded).drop(columns=list(self.aside))
        for name, others in self.spreads.items():
            left, right = "()" if len(others) == 1 else "[]"
            added = shown[others[0]].str.cat([shown[other] for other in others[1:]], sep=", ")
            there = self.frame[others[0]].map(_exists)
            words = others[0] if len(others) == 1 else "95 %"
            shown[name] += (" " + left + added + right).where(there, "")
            shown = shown.drop(columns=list(others)).rename(columns={name: f"{name} {left}{words}{right}"})
        return shown

    def markdown(self) -> str:
        """The table as Markdown for readers, with title and note."""
        shown = self.readable()
        lines = [f"## {self.title}", ""]
        lines += [f"| {' | '.join(shown.columns)} |", f"|{' --- |' * len(shown.columns)}"]
        lines += [f"| {' | '.join(row)} |" for row in shown.itertuples(index=False)]
        return "\n".join([*lines, "", *([self.note, ""] if self.note else [])])

    def html(self) -> str:
        """The table as HTML for readers, without title."""
        shown = self.readable().map(html.escape)
        shown.columns = [html.escape(name).replace("_", "_<wbr>").replace(".", ".<wbr>") for name in shown.columns]
        note = f"<p class=note>{html.escape(self.note)}</p>" if self.note else ""
        return f"<div class=table>{shown.to_html(index=False, border=0, escape=False)}</div>{note}"


def plain(setting: Sequence[object]) -> list[Value]:
    """Convert the values of a setting to a table's values."""
    return [value if isinstance(value, int | float | str) else str(value) for value in setting]


def rounded(value: Value) -> str:
    """Format a value for readers: four digits, or all digits of an integer."""
    if not _exists(value):
        return "-"
    if isinstance(value, float) and not value.is_integer():
        return f"{value:.1f}" if abs(value) >= 100 else f"{value:.3g}"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _exists(value: Value) -> bool:
    return value is not None and not (isinstance(value, float) and math.isnan(value))


def _exact(value: Value) -> str:
    if not _exists(value):
        return ""
    return f"{value:.10g}" if isinstance(value, float) else str(value)
