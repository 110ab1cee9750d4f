"""`swarm sweep`: a study over many processes or machines."""

from __future__ import annotations

import json
import re
import signal
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from rich import box
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from launch_scripts.simulation.study.needs import check_installed
from swarm.config.input_files import quoted
from swarm.errors import ConfigError

if TYPE_CHECKING:
    from launch_scripts.simulation.study.run import Sweep
    from launch_scripts.simulation.study.summary import Summary
    from launch_scripts.simulation.study.trial import Result, Trial


_SCHEDULER = r"(?:tcp|tls|wss?)://[^\s/:]+:[0-9]{1,5}"
_EXAMPLE = "tcp://127.0.0.1:8786"


def sweep_study(name: str, scheduler: str | None, workers: int | None, out: Path | None, as_json: bool) -> bool:
    """Run what a study lacks, and print its summary. True if every trial has a result and no law broke."""
    check_installed()
    if scheduler is not None and workers is not None:
        raise ConfigError("--workers goes without --scheduler: the workers of that cluster are used")
    if scheduler is not None and re.fullmatch(_SCHEDULER, scheduler) is None:
        raise ConfigError(f"--scheduler: found {quoted(scheduler)}, expected an address such as {_EXAMPLE}")
    from launch_scripts.simulation.study.cluster import cores
    from launch_scripts.simulation.study.run import Sweep
    from launch_scripts.simulation.study.study import study_path

    sweep = Sweep(study_path(name), out)
    console = Console(stderr=True, highlight=False, soft_wrap=True, markup=False, emoji=False)
    kept = sweep.trials - len(sweep.missing)
    if kept:
        console.print(f"{kept:,} of {sweep.trials:,} trials are kept from before in {sweep.folder}")
    stops = _hear_stops()
    try:
        _run(sweep, console, workers or cores(), scheduler, stops)
    except KeyboardInterrupt:
        there = sum(trial.key in sweep.store.results for trial in sweep.missing) + kept
        with suppress(KeyboardInterrupt):
            console.print(f"{there:,} of {sweep.trials:,} trials are kept in {sweep.folder}; start again to go on")
        raise
    summary = sweep.finish()
    if as_json:
        from launch_scripts.simulation.study.summary import as_json as told

        print(json.dumps(told(summary), indent=2))
    else:
        _print(summary, sweep.folder)
    return not summary.failing and not summary.missing


def _hear_stops() -> list[int]:
    """The signals to stop that have come, to which more are added as they come. Each interrupts at once, too; but
    what is raised while Python clears something away, as a future of Dask, is lost.

    SIGTERM is one of them, as a batch system or `timeout` ends a sweep: workers and their folder go with it.
    """
    stops: list[int] = []
    interrupt = signal.getsignal(signal.SIGINT)

    def stop(number: int, frame: FrameType | None) -> None:
        stops.append(number)
        if callable(interrupt):
            interrupt(signal.SIGINT, frame)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    return stops


def _run(sweep: Sweep, console: Console, workers: int, scheduler: str | None, stops: list[int]) -> None:
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[failed]} broke a law"),
    )
    failed = 0
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(sweep.study.name, total=sweep.trials, failed=0)
        bar.update(task, completed=sweep.trials - len(sweep.missing))

        def told(trial: Trial, result: Result | None) -> None:
            nonlocal failed
            failed += bool(result is not None and result.broken)
            for law in result.broken[:1] if result is not None else ():
                console.print(f"{trial.world} seed {trial.seed} broke a law: {law}")
            if result is None:
                console.print(f"{trial.world} seed {trial.seed} is given up: each worker that ran it died")
            while sweep.warned:
                console.print(sweep.warned.pop(0))
            bar.update(task, advance=1, failed=failed)
            if stops:
                raise KeyboardInterrupt

        sweep.run(workers, scheduler, told)


def _print(summary: Summary, folder: Path) -> None:
    from launch_scripts.simulation.study.page import between, number
    from launch_scripts.simulation.study.run import PAGE, RESULTS

    console = Console(highlight=False, markup=False, emoji=False)
    several = len({case.scenario for case in summary.cases}) > 1
    for name in summary.cases[0].outcomes:
        table = Table(title=name, title_justify="left", box=box.SIMPLE_HEAD)
        table.add_column("case", no_wrap=True)
        for heading in ("n", "mean", "95 %", "to the first", "95 %"):
            table.add_column(heading, justify="right", no_wrap=True)
        for case in summary.cases:
            outcome = case.outcomes[name]
            table.add_row(
                f"{case.scenario}: {case.label}" if several else case.label,
                str(len(outcome.values)),
                number(outcome.mean),
                between(outcome.mean),
                number(outcome.difference, "+"),
                between(outcome.difference, "+"),
            )
        console.print(table)
    for failure in summary.failing[:20]:
        console.print(f"failed: {failure.replay}", soft_wrap=True)
    missing = f"; {summary.missing:,} have no result" if summary.missing else ""
    console.print(f"{len(summary.failing):,} of {summary.trials:,} trials broke a law{missing}")
    console.print(f"summary: {folder / PAGE}, results: {folder / RESULTS}", soft_wrap=True)
