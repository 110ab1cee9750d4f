"""The summary of a study as Markdown, with a picture of each outcome: every seed a dot, the mean and its interval.

Its tables are what the command prints, too: their columns are aligned."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from launch_scripts.simulation.study.summary import METHOD, Estimate, Summary

SHOWN_FAILURES = 100
MOST_ROWS = 60
"""Of more cases there is no picture: nobody reads it."""


def document(summary: Summary, pictures: Mapping[str, str]) -> str:
    """The page.

    pictures  outcome -> file name of its picture, beside the page
    """
    done = summary.trials - summary.missing
    told = (
        f"{done:,} of {summary.trials:,} trials, {summary.simulated_s:,.0f} simulated seconds in "
        f"{summary.cpu_s:,.0f} s of CPU. {len(summary.failing):,} trials broke a law."
    )
    parts = [
        f"# {summary.study}",
        summary.about,
        told,
        _table(
            ("scenario", "case", "trials", "broke a law", "share"),
            [
                (case.scenario, case.label, f"{case.trials:,}", f"{case.broken:,}", _percent(case.share_broken))
                for case in summary.cases
            ],
        ),
    ]
    for name in summary.cases[0].outcomes:
        parts += [f"## {name}", f"![{name}]({pictures[name]})" if name in pictures else ""]
        parts.append(outcome_table(summary, name))
    if summary.failing:
        rows = [
            (each.scenario, each.label, str(each.seed), ", ".join(each.laws), each.sentences[0], f"`{each.replay}`")
            for each in summary.failing[:SHOWN_FAILURES]
        ]
        headings = ("scenario", "case", "seed", "laws", "first sentence", "again")
        parts += ["## Trials that broke a law", _table(headings, rows)]
    if (left := len(summary.failing) - SHOWN_FAILURES) > 0:
        parts.append(f"{left:,} more are in `results.parquet`.")
    return "\n\n".join(filter(None, [*parts, METHOD])) + "\n"


def outcome_table(summary: Summary, name: str) -> str:
    """A row for each case: an outcome, and by what it differs from that of the first case."""
    rows = [
        (
            case.scenario,
            case.label,
            str(len(outcome.values)),
            *_cells(outcome.mean),
            *_cells(outcome.median),
            *_cells(outcome.difference, "+"),
        )
        for case in summary.cases
        for outcome in [case.outcomes[name]]
    ]
    headings = ("scenario", "case", "n", "mean", "95 %", "median", "95 %", "to the first case", "95 %")
    return _table(headings, rows)


def _table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    escaped = [[cell.replace("|", "\\|").replace("\n", " ") for cell in row] for row in (headings, *rows)]
    widths = [max(map(len, column)) for column in zip(*escaped, strict=True)]
    first, *rest = (f"| {' | '.join(map(str.ljust, row, widths))} |" for row in escaped)
    return "\n".join([first, f"|{'|'.join('-' * (width + 2) for width in widths)}|", *rest])


def _number(value: float | None, sign: str = "") -> str:
    """Four significant digits, all digits of what is 1,000 or more."""
    if value is None:
        return "-"
    value = value + 0.0  # no minus zero
    return f"{value:{sign},.0f}" if abs(value) >= 1000 else f"{value:{sign}.4g}"


def _percent(share: Estimate | None) -> str:
    if share is None:
        return "-"
    return f"{100 * share.value:.3g} % ({100 * (share.low or 0.0):.3g} to {100 * (share.high or 0.0):.3g})"


def _cells(estimate: Estimate | None, sign: str = "") -> tuple[str, str]:
    """A value, and the two ends of its interval."""
    if estimate is None:
        return "-", "-"
    low, high = _number(estimate.low, sign), _number(estimate.high, sign)
    return _number(estimate.value, sign), "-" if estimate.low is None else f"{low} to {high}"


def pictures_of(summary: Summary) -> dict[str, str]:
    """The outcomes of which there is a picture -> its file name."""
    names = summary.cases[0].outcomes if len(summary.cases) <= MOST_ROWS else ()
    drawn = (name for name in names if any(case.outcomes[name].values for case in summary.cases))
    return {name: f"{re.sub('[^A-Za-z0-9_.-]', '-', name)}.png" for name in drawn}
