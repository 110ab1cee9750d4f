"""Differences between runs, and their metrics beside each other. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from launch_scripts.observe.run_state import REPORTED, SUMMED
from launch_scripts.observe.summed_counts import percent, sum_of

_WHERE_ONLY = ("network.listen", "network.connect", "monitor.web_port")
"""Keys that say where a run was met, not what ran: free ports differ each time."""


@dataclass(frozen=True)
class LeftRun:
    """Files of a finished run.

    settings  its scenario, as TOML was read; None where there is no file of it
    """

    name: str
    report: Mapping[str, Any]
    settings: Mapping[str, Any] | None


Row = tuple[str, list[Any]]
"""A key or figure, and its value in each run; None where a run has none."""


def settings_that_differ(runs: Sequence[LeftRun]) -> list[Row]:
    """Keys of the scenarios whose values are not the same in all runs that have a scenario."""
    found = _that_differ([None if run.settings is None else dict(_flat(run.settings, "")) for run in runs])
    return [row for row in found if not row[0].startswith(_WHERE_ONLY)]


def circumstances_that_differ(runs: Sequence[LeftRun]) -> list[Row]:
    """Versions, machines, terrains, and kinds of run that are not the same: what makes figures incomparable."""
    flat = []
    for report in (run.report for run in runs):
        made, digest = _table(report.get("made")), _table(report.get("terrain")).get("digest")
        of = [each for name in ("versions", "machine") for each in _flat(made.get(name) or {}, name)]
        flat.append({**dict(of), "terrain": digest, "simulated": "simulated" in report})
    return _that_differ(flat)


def _that_differ(runs: Sequence[Mapping[str, Any] | None]) -> list[Row]:
    """Keys whose values are not the same in all runs of which they are known."""
    known = [each for each in runs if each is not None]
    return [
        (key, [None if each is None else each.get(key) for each in runs])
        for key in dict.fromkeys(key for each in known for key in each)
        if any(each.get(key) != known[0].get(key) for each in known)
    ]


def figures(runs: Sequence[LeftRun]) -> list[Row]:
    """The figures of all runs, by what people call them."""
    flat: list[dict[str, Any]] = []
    for report in (run.report for run in runs):
        named = _flat({label: report.get(name) for name, label in REPORTED.items()}, "")
        groups, targets = _table(report.get("by_group")), _table(report.get("by_target"))
        flat.append(
            {key.replace(".", ", "): value for key, value in named}
            | {label: _sum(groups, name) for name, label in SUMMED.items()}
            | {f"captures of {id}": _table(row).get("captures") for id, row in targets.items()}
        )
    rows = [(key, [each.get(key) for each in flat]) for key in dict.fromkeys(key for each in flat for key in each)]
    return [row for row in rows if any(value is not None for value in row[1])]


def text_of(label: str, value: Any) -> str:
    """A value for people."""
    if value is None:
        return "-"
    if isinstance(value, bool) or not isinstance(value, int | float):
        return str(value)
    if label.startswith("certified gap, ") and not label.endswith("unproven"):
        return percent(value)
    return f"{value:,.4g}" if isinstance(value, float) else f"{value:,}"


def _flat(value: Any, path: str) -> Iterator[tuple[str, Any]]:
    """`terrain.hidden.closed_roads`, `targets[0].count`; a list of values is one value."""
    if isinstance(value, Mapping) and value:
        for key, each in value.items():
            yield from _flat(each, f"{path}.{key}" if path else str(key))
    elif isinstance(value, list) and value and all(isinstance(each, Mapping) for each in value):
        for n, each in enumerate(value):
            yield from _flat(each, f"{path}[{n}]")
    else:
        yield path, value


def _table(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _sum(groups: Mapping[str, Any], name: str) -> float | None:
    return sum_of(value for row in groups.values() if isinstance(value := _table(row).get(name), int | float))
