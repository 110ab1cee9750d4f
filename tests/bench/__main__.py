"""The command `./launch_scripts/bench`."""

from __future__ import annotations

import sys

from bench.cli import app
from launch_scripts.command_line.run_command import run_command

if __name__ == "__main__":
    import typer

    sys.exit(run_command(lambda: typer.main.get_command(app), "bench"))
