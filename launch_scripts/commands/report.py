"""`swarm report` and `swarm export`: what a run has left, for people and for other programs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from launch_scripts.observe.run_folder import find_run
from swarm.config.explain import choice
from swarm.errors import ConfigError


def write_report_page(run: str, runs: Path) -> None:
    """Write a run's page again. Raises ConfigError or StoreError in one sentence."""
    from launch_scripts.report.run_page import write_page

    print(write_page(find_run(run, runs)))


def export_from(
    run: str,
    runs: Path,
    what: Sequence[str],
    format: str,
    out: Path | None,
    force: bool,
    mcap: bool,
) -> None:
    """Write files of a run. Raises ConfigError or StoreError in one sentence."""
    from launch_scripts.report.run_layers import ENDINGS, WHAT, export_run

    for option, given, allowed in (("--what", what, tuple(WHAT)), ("--format", [format], ENDINGS)):
        for each in given:
            if each not in allowed:
                raise ConfigError(f"{option}: found {each!r}{choice(each, tuple(allowed))}")
    folder = find_run(run, runs)
    if mcap:
        from launch_scripts.report.mcap_export import export_mcap

        print(export_mcap(folder, out, force))
        return
    for line in export_run(folder, what, format, out, force):
        print(line)
