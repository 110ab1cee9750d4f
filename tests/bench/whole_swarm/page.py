"""The page of figures in the documentation: each run replaces the section of its kind. Markdown."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from bench.tables import on_machine
from bench.whole_swarm import crowd
from bench.whole_swarm.figures import LIVE, SIMULATED, Figure, topic_figures
from bench.whole_swarm.series import figures_of, lines_of, remarks
from swarm.errors import ConfigError, StoreError

_TITLE = "# Scale figures"
_INTRO = f"""{_TITLE}

Written by `bench swarm ... --write docs/scale-figures.md`: each run replaces the section of its kind.

The swarm is that of the built-in scenario `thousand`, with a map that grows with the vehicles, 262 cells a vehicle.
Unless said otherwise it has an agent for each five hundred vehicles, at least 5 and at most 40. *Power* is the
exponent of the power of the number of vehicles that fits best. Trust ratios and CPU times more than times by the
clock, which grow with other work on the machine.
[Decision 36](decisions/0036-how-a-whole-swarm-is-measured.md) says how it is measured.
"""
_MEANINGS = "What the rows say"
_ORDER = (_MEANINGS, "Live processes", "Simulation", "Crowds")


def check(path: Path) -> None:
    """Raises ConfigError on a path that is no such page and can be none, before minutes of measuring."""
    if path.suffix != ".md" or not path.absolute().parent.is_dir():
        raise ConfigError(f"--write is {path}, expected a name that ends in .md, in a folder that is there")
    try:
        if path.exists() and not path.read_text(encoding="utf-8").startswith(_TITLE):
            raise ConfigError(f"--write is {path}, which is another page: it does not begin with {_TITLE!r}")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"--write is {path}, which cannot be read: {error}") from error


def write_sizes(path: Path, report: dict[str, Any], command: str) -> None:
    """Replace the section of this kind of run, as `series.run_series` reports it. Raises StoreError."""
    _write_section(path, _heading(report), "\n".join(_sizes(report, command)))


def write_crowds(path: Path, report: dict[str, Any], command: str) -> None:
    """Replace the section of crowds, as `crowd.run` reports them. Raises StoreError."""
    _write_section(path, _ORDER[3], "\n".join(_crowds(report, command)))


def _write_section(path: Path, heading: str, text: str) -> None:
    try:
        sections: dict[str, str] = {}
        if path.exists():
            for part in path.read_text(encoding="utf-8").split("\n## ")[1:]:
                name, _, kept = part.partition("\n")
                sections[name] = kept.strip("\n")
        sections[heading] = text
        sections[_MEANINGS] = "\n".join(_meanings())
        ordered = sorted(sections, key=lambda each: (_rank(each), each))
        parts = [_INTRO, *(f"## {each}\n\n{sections[each]}\n" for each in ordered)]
        path.write_text("\n".join(parts), encoding="utf-8")
    except OSError as error:
        raise StoreError(f"cannot write {path}: {error.strerror or error}") from error


def _heading(report: dict[str, Any]) -> str:
    rows = report["rows"]
    heading = _ORDER[2] if report["simulated"] else _ORDER[1]
    if len(rows) > 1 and len({row["per_agent"] for row in rows}) == 1:
        heading += f", {rows[0]['per_agent']} vehicles an agent"
    return heading


def _rank(heading: str) -> int:
    return next((n for n, known in enumerate(_ORDER) if heading.startswith(known)), len(_ORDER))


def _sizes(report: dict[str, Any], command: str) -> Iterator[str]:
    rows = report["rows"]
    yield f"`{command}`"
    yield ""
    yield (
        f"{rows[0]['targets']} targets, ticks of {rows[0]['tick_hz']:g} Hz, {report['seconds']:g} s measured. "
        f"{on_machine(report)}"
    )
    yield ""
    sizes = [
        ["agents", *(f"{row['agents']:,}" for row in rows)],
        ["cells a side", *(f"{row['side']:,}" for row in rows)],
    ]
    yield from _table(report, "vehicles", sizes, figures_of(report))
    if topics := topic_figures(rows):
        yield ""
        yield "Delivered by topic, kB/s:"
        yield ""
        yield from _table(report, "topic", [], topics)
    for remark in remarks(report):
        yield ""
        yield remark


def _crowds(report: dict[str, Any], command: str) -> Iterator[str]:
    yield f"`{command}`"
    yield ""
    yield f"{' '.join(crowd.remarks(report))} {on_machine(report)}"
    yield ""
    headings = (heading.replace("-\n", "").replace("\n", " ") for heading, _ in crowd.COLUMNS)
    yield f"| {' | '.join(headings)} |"
    yield "|---" * len(crowd.COLUMNS) + "|"
    for row in report["rows"]:
        yield f"| {' | '.join(write(row) for _, write in crowd.COLUMNS)} |"


def _table(
    report: dict[str, Any], first: str, above: Sequence[list[str]], figures: Sequence[Figure]
) -> Iterator[str]:
    headings = [first, *(f"{row['vehicles']:,}" for row in report["rows"])]
    if len(report["rows"]) > 1:
        headings.append("power")
    yield f"| {' | '.join(headings)} |"
    yield "|---" * len(headings) + "|"
    for label, *cells in [*above, *lines_of(report, figures)]:
        padded = [*cells, *[""] * (len(headings) - 1 - len(cells))]
        shown = f"&nbsp;&nbsp;{label.strip()}" if label.startswith(" ") else label
        yield f"| {' | '.join([shown, *padded])} |"


def _meanings() -> Iterator[str]:
    yield "| row | what it says |"
    yield "|---|---|"
    for label, meaning in {each.label: each.meaning for each in (*LIVE, *SIMULATED) if each.meaning}.items():
        yield f"| {label.strip()} | {meaning} |"
