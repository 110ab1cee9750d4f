"""Checks before a swarm runs: of a scenario and of this machine.

Each check yields findings: a sentence with the key or the part of the machine, the value found, the
value expected and the remedy. A failure prevents the run; a warning states that it differs from what one may
expect. `swarm check` and `swarm up` ask the same functions of `scenario_check`, `swarm doctor` those of
`machine_check`.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

from launch_scripts.plain_text import number_of
from swarm.errors import require

require(__name__, "numpy")

Level = Literal["ok", "warning", "failure"]
STYLES: dict[Level, str] = {"ok": "green", "warning": "yellow", "failure": "red"}


class Finding(NamedTuple):
    """One line of an answer.

    level  failure: it cannot run so; warning: it runs, but not as one may think
    about  a key of the scenario, or a part of the machine
    text   the value found, the value expected, and the remedy
    """

    level: Level
    about: str
    text: str

    @property
    def sentence(self) -> str:
        return f"{self.about}: {self.text}" if self.about else self.text


def failure(about: str, text: str) -> Finding:
    return Finding("failure", about, text)


def warning(about: str, text: str) -> Finding:
    return Finding("warning", about, text)


def counted(findings: Sequence[Finding], level: Level) -> str:
    """Returns the number of findings of a level: "1 failure", "no warnings"."""
    return number_of(sum(finding.level == level for finding in findings), level)


def answer(found: Sequence[Finding], as_json: bool, facts: dict[str, Any], summary: str = "") -> int:
    """Prints a line for each finding, and a last one: how many are wrong, or `summary` where none is a failure.
    As JSON it has the facts, too. Returns the exit code."""
    from rich.console import Console  # a bare install has none
    from rich.text import Text

    failed = any(finding.level == "failure" for finding in found)
    if as_json:
        output = {**facts, "ok": not failed, "findings": [finding._asdict() for finding in found]}
        print(json.dumps(output, indent=2))
        return int(failed)
    console = Console(soft_wrap=True, highlight=False)
    for finding in found:
        console.print(Text.assemble((f"{finding.level}: ", STYLES[finding.level]), finding.sentence))
    if summary and not failed:
        console.print(summary)
    elif len(found) > 1:
        console.print(f"{counted(found, 'failure')}, {counted(found, 'warning')}")
    return int(failed)
