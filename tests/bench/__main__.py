"""The command `./launch_scripts/bench`: a benchmark by name, or a list of all."""

from __future__ import annotations

import sys

import typer

from bench.harness import BENCHMARKS, load
from launch_scripts.typer_commands import run_command

if __name__ == "__main__":
    # Imports are lazy: kernels, Zenoh and rasterio take seconds to import.
    asked = [word for word in sys.argv[1:2] if word in BENCHMARKS]
    sys.exit(run_command(lambda: typer.main.get_command(load(asked or BENCHMARKS)), "./launch_scripts/bench"))
