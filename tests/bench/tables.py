"""Tables which fit 80 columns, the format of figures, and the type of progress callbacks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rich import box
from rich.table import Table

from swarm.config.values import Strategy

Progress = Callable[[int, int], None]
"""Called with (steps done, steps in all)."""

_LABELS: dict[Strategy, str] = {
    "multi_resolution": "multi-resolution",
    "variable_range+multi_resolution": "both, the paper's",
}
_NARROW: dict[Strategy, str] = {
    "variable_range": "var.\nrange",
    "multi_resolution": "multi-\nresol.",
    "variable_range+multi_resolution": "both",
}


def label_of(strategy: Strategy) -> str:
    """A strategy in the paper's words, where it has any."""
    return _LABELS.get(strategy) or strategy.replace("_", " ")


def narrow_label_of(strategy: Strategy) -> str:
    """As `label_of`, in two short lines."""
    return _NARROW.get(strategy) or strategy.replace("_", "\n", 1)


def table(title: str, *columns: str) -> Table:
    """A table with right-aligned columns; a name which begins with < is left-aligned."""
    found = Table(
        title=title,
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        pad_edge=False,
    )
    for name in columns:
        words = name.startswith("<")
        found.add_column(name.removeprefix("<"), justify="left" if words else "right", no_wrap=True)
    return found


def number(value: float | None) -> str:
    """Three significant digits."""
    if value is None:
        return "-"
    decimals = 0 if value >= 99.95 else 1 if value >= 9.995 else 2 if value >= 0.995 else 3
    return f"{value:,.{decimals}f}"


def times(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f} x"


def percent(gap: float | None) -> str:
    """Per cent by which a gap, cost over optimum, exceeds 1."""
    if gap is None:
        return "-"
    above = 100 * (gap - 1)
    return f"{above:.2f}" if above < 9.995 else f"{above:,.0f}"


def on_machine(report: dict[str, Any]) -> str:
    """One sentence on where the figures come from."""
    return f"{report['cores']} x {report['machine']}, Python {report['python']}, load {report['load']}."
