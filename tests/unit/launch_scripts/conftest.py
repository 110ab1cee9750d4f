"""The command `swarm` as a user types it, and a run that it may be asked about."""

import sys
from pathlib import Path
from typing import Any

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


@pytest.fixture(scope="session")
def left_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    """The folder of a run, and its recorder."""
    from support.fake_run import leave_run  # takes time to import

    folder = tmp_path_factory.mktemp("runs") / "r1"
    folder.mkdir()
    return folder, leave_run(folder)


@pytest.fixture(scope="session")
def run(left_run: tuple[Path, Any]) -> Path:
    return left_run[0]
