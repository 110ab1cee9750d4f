"""Runs a benchmark as its command does."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

from bench import harness
from typer.testing import CliRunner, Result


def command(*words: object, timeout_s: float = 60.0) -> subprocess.CompletedProcess[str]:
    """Runs `./launch_scripts/bench` to its end, in a process of its own."""
    called = [sys.executable, "-m", "bench", *map(str, words)]
    return subprocess.run(called, capture_output=True, text=True, timeout=timeout_s, check=False)


def run(*words: str) -> Result:
    harness.load(word for word in words[:1] if word in harness.BENCHMARKS)
    return CliRunner().invoke(harness.app, list(words), catch_exceptions=False)


def bench(*words: str) -> dict[str, Any]:
    """The report of a benchmark which ends well, as --json prints it."""
    done = run(*words, "--json")
    assert done.exit_code == 0, done.output
    report: dict[str, Any] = json.loads(done.stdout)
    return report
