"""The summary of a study as Markdown, with a picture of each outcome: every seed a dot, the mean and its
interval."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

from launch_scripts.simulation.study.summary import METHOD, Estimate, Summary

SHOWN_FAILURES = 100


def document(summary: Summary, pictures: dict[str, str]) -> str:
    """The page.

    pictures  outcome -> file name of its picture, beside the page
    """
    return "\n".join(_lines(summary, pictures)) + "\n"


def _lines(summary: Summary, pictures: dict[str, str]) -> Iterator[str]:
    yield f"# {summary.study}\n"
    if summary.about:
        yield f"{summary.about}\n"
    done = summary.trials - summary.missing
    yield (
        f"{done:,} of {summary.trials:,} trials, {summary.simulated_s:,.0f} simulated seconds in "
        f"{summary.cpu_s:,.0f} s of CPU. {len(summary.failing):,} trials broke a law.\n"
    )
    yield "| scenario | case | trials | broke a law | share |"
    yield "|---|---|---|---|---|"
    for case in summary.cases:
        share = "-" if case.share_broken is None else percent(case.share_broken)
        yield _row(case.scenario, case.label, f"{case.trials:,}", f"{case.broken:,}", share)
    yield ""
    for name in summary.cases[0].outcomes:
        yield f"## {name}\n"
        if name in pictures:
            yield f"![{name}]({pictures[name]})\n"
        yield "| scenario | case | n | mean | 95 % | median | 95 % | to the first case | 95 % |"
        yield "|---|---|---|---|---|---|---|---|---|"
        for case in summary.cases:
            outcome = case.outcomes[name]
            yield _row(
                case.scenario,
                case.label,
                str(len(outcome.values)),
                *_cells(outcome.mean),
                *_cells(outcome.median),
                *_cells(outcome.difference, "+"),
            )
        yield ""
    yield from _failures(summary)
    yield f"{METHOD}\n"


def _failures(summary: Summary) -> Iterator[str]:
    if not summary.failing:
        return
    yield "## Trials that broke a law\n"
    yield "| scenario | case | seed | laws | first sentence | again |"
    yield "|---|---|---|---|---|---|"
    for each in summary.failing[:SHOWN_FAILURES]:
        laws = ", ".join(each.laws)
        yield _row(each.scenario, each.label, str(each.seed), laws, each.sentences[0], f"`{each.replay}`")
    if (left := len(summary.failing) - SHOWN_FAILURES) > 0:
        yield f"\n{left:,} more are in `results.parquet`."
    yield ""


def number(value: Estimate | float | None, sign: str = "") -> str:
    """Four significant digits, all digits of what is 1,000 or more."""
    if isinstance(value, Estimate):
        value = value.value
    if value is None:
        return "-"
    value = value + 0.0  # no minus zero
    return f"{value:{sign},.0f}" if abs(value) >= 1000 else f"{value:{sign}.4g}"


def between(estimate: Estimate | None, sign: str = "") -> str:
    """The two ends of an interval."""
    if estimate is None or estimate.low is None:
        return "-"
    return f"{number(estimate.low, sign)} to {number(estimate.high, sign)}"


def percent(share: Estimate) -> str:
    low, high = share.low or 0.0, share.high or 0.0
    return f"{100 * share.value:.3g} % ({100 * low:.3g} to {100 * high:.3g})"


def _cells(estimate: Estimate | None, sign: str = "") -> Sequence[str]:
    return number(estimate, sign), between(estimate, sign)


def _row(*cells: str) -> str:
    return f"| {' | '.join(cell.replace('|', chr(92) + '|').replace(chr(10), ' ') for cell in cells)} |"


MOST_ROWS = 60
"""Of more cases there is no picture: nobody reads it."""


def file_name(outcome: str) -> str:
    """Of the picture of an outcome."""
    return f"{re.sub('[^A-Za-z0-9_.-]', '-', outcome)}.png"


def drawn(summary: Summary) -> list[str]:
    """The outcomes of which there is a picture."""
    if len(summary.cases) > MOST_ROWS:
        return []
    names = summary.cases[0].outcomes
    return [name for name in names if any(case.outcomes[name].values for case in summary.cases)]
