"""Swarms of several sizes, one after the other, live or simulated."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import msgspec
from rich.table import Table

from bench.machine import machine
from bench.tables import table
from bench.whole_swarm.figures import (
    LIVE,
    MOST_LATE_SHARE,
    SIMULATED,
    Figure,
    exponents,
    keeps_pace,
    topic_figures,
)
from bench.whole_swarm.live import Tell, measure_live
from bench.whole_swarm.simulated import measure_simulated
from bench.whole_swarm.size import Size
from swarm.errors import SwarmError

SERIES = (100, 300, 1000, 3000, 10_000)


def run_series(sizes: Sequence[Size], seconds: float, simulated: bool, tell: Tell) -> dict[str, Any]:
    """Measure each size. One that cannot be measured says why, and the others go on; of a single one SwarmError is
    raised. An interrupt keeps what has been measured."""
    rows: list[dict[str, Any]] = []
    report: dict[str, Any] = {"simulated": simulated, "seconds": seconds, "rows": rows, "interrupted": False}
    try:
        for size in sizes:
            tell(f"{size.vehicles:,} vehicles of {size.agents} agents, {size.side} x {size.side} cells")
            try:
                if simulated:
                    figures = measure_simulated(size, seconds)
                else:
                    figures = measure_live(size, seconds, tell)
            except SwarmError as error:
                if len(sizes) == 1:
                    raise
                tell(f"not measured: {error}")
                figures = {"failed": str(error)}
            rows.append({**msgspec.structs.asdict(size), **figures})
    except KeyboardInterrupt:
        report["interrupted"] = True
        tell("interrupted: the figures are of the sizes that were measured")
    measured = [row for row in rows if "failed" not in row]
    report["exponents"] = exponents([*figures_of(report), *topic_figures(measured)], measured)
    return {**report, **machine()}


def figures_of(report: dict[str, Any]) -> tuple[Figure, ...]:
    return SIMULATED if report["simulated"] else LIVE


def broken(report: dict[str, Any]) -> list[str]:
    """What must not be: vehicles that met, runs that failed or did not end in order."""
    found = ["interrupted"] if report["interrupted"] else []
    for row in report["rows"]:
        title = f"{row['vehicles']:,} vehicles: "
        if "failed" in row:
            found.append(f"{title}not measured: {row['failed']}")
            continue
        for name in ("collisions", "lethal_entries"):
            if row.get(name):
                found.append(f"{title}{row[name]} {name.replace('_', ' ')}")
        if row.get("exit_code"):
            found.append(f"{title}the launcher ended with code {row['exit_code']}: {row['last_words']}")
    return found


def lines_of(report: dict[str, Any], figures: Sequence[Figure]) -> list[list[str]]:
    """Label, a value for each size, and the exponent where there are several."""
    rows = report["rows"]
    lines = []
    for figure in figures:
        line = [figure.label, *("-" if "failed" in row else figure.shown(row) for row in rows)]
        if len(rows) > 1:
            fitted = report["exponents"].get(figure.key)
            line.append("" if fitted is None else f"{fitted:.2f}")
        lines.append(line)
    return lines


def remarks(report: dict[str, Any]) -> list[str]:
    """What has to be known to read the figures: what is missing and why, and what the exponents are of."""
    rows = report["rows"]
    found = []
    for row in rows:
        found += [f"{row['vehicles']:,} vehicles: not measured: {each}." for each in row.get("not_measured", ())]
    late = [row for row in rows if "failed" not in row and not keeps_pace(row)]
    if late and len(rows) > 1:
        sizes = " and ".join(f"{row['vehicles']:,}" for row in late)
        found.append(
            f"Powers are fitted without {sizes} vehicles, where agents are late in more than "
            f"{100 * MOST_LATE_SHARE:g} % of their ticks: their rates are those of a swarm that does less than it "
            "should."
        )
    return found + [f"{each}." for each in broken(report)]


def tables(report: dict[str, Any]) -> Iterator[Table | str]:
    rows = report["rows"]
    if not rows:
        return
    first = rows[0]
    how = "simulated" if report["simulated"] else "live"
    yield f"{how}, {first['targets']} targets, ticks of {first['tick_hz']:g} Hz, {report['seconds']:g} s measured."
    yield from (
        f"{row['vehicles']:,} vehicles: {row['agents']} agents, {row['side']} cells a side." for row in rows
    )
    sizes = [f"{row['vehicles']:,}" for row in rows]
    headings = ["<vehicles", *sizes, *(["power"] if len(rows) > 1 else [])]
    found = table("Figures of a swarm", *headings)
    for line in lines_of(report, figures_of(report)):
        found.add_row(*line)
    yield found
    if topics := topic_figures(rows):
        found = table("Delivered by topic, kB/s", *headings)
        for line in lines_of(report, topics):
            found.add_row(*line)
        yield found
    for figure in figures_of(report):
        if figure.meaning:
            yield f"{figure.label.strip()}: {figure.meaning}"
    yield from remarks(report)
