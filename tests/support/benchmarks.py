"""Runs a benchmark as its command does."""

from __future__ import annotations

import json
from typing import Any

from bench import harness
from typer.testing import CliRunner, Result


def run(*words: str) -> Result:
    harness.load(word for word in words[:1] if word in harness.BENCHMARKS)
    return CliRunner().invoke(harness.app, list(words), catch_exceptions=False)


def bench(*words: str) -> dict[str, Any]:
    """The report of a benchmark which ends well, as --json prints it."""
    done = run(*words, "--json")
    assert done.exit_code == 0, done.output
    report: dict[str, Any] = json.loads(done.stdout)
    return report


def assert_fits(*words: str) -> str:
    """What a benchmark prints, of which no line is longer than 80 columns and no word is cut."""
    done = run(*words)
    assert done.exit_code == 0, done.output
    assert max(len(line.rstrip()) for line in done.output.splitlines()) <= 80, done.output
    assert "…" not in done.output, done.output
    return done.output
