"""Findings of a check: a sentence for people, with its level."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

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
    many = sum(finding.level == level for finding in findings)
    return f"{many or 'no'} {level}{'' if many == 1 else 's'}"


def as_fields(findings: Sequence[Finding]) -> dict[str, Any]:
    """For `--json`."""
    return {
        "ok": not any(finding.level == "failure" for finding in findings),
        "findings": [finding._asdict() for finding in findings],
    }
