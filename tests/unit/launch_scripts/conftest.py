"""The command `swarm` as a user types it."""

import sys

import pytest
from support.command import Swarm

from launch_scripts.cli import main


@pytest.fixture
def swarm(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Swarm:
    """Runs the command in this process, on a terminal of 120 columns. Takes a line, and words that may hold spaces;
    returns (exit code, standard output, standard error)."""
    monkeypatch.setenv("COLUMNS", "120")

    def run(line: str, *words: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["swarm", *line.split(), *map(str, words)])
        try:
            code = main()
        except SystemExit as end:
            code = int(end.code or 0)
        return code, *capsys.readouterr()

    return run
