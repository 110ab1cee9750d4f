"""`swarm simulate` and `swarm study`: a swarm in one process, with many seeds, and over many machines."""

from __future__ import annotations

import contextlib
import json
import re
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
import typer

from launch_scripts.commands.shared_options import AsJson, Force, Runs, Seconds, Seed
from launch_scripts.plain_text import number_of
from launch_scripts.stop_requests import stop_requests
from launch_scripts.typer_commands import RUN, command, complete_scenarios, family_app
from swarm.config.input_files import quoted
from swarm.errors import ConfigError
from swarm.files import writing

if TYPE_CHECKING:
    from rich.console import Console

    from launch_scripts.simulation.study_sweep import Sweep
    from launch_scripts.simulation.trials import Result, Trial

app = typer.Typer()
study_app = family_app("Run scenarios with many settings and seeds, on many processes and machines.")
_SCHEDULER = r"(?:tcp|tls|wss?)://[^\s/:]+:[0-9]{1,5}"
_SHOWN_FAILURES = 20
"""Commands that replay a failure. A terminal of 24 lines shows this number and the last sentence; results.parquet
has every trial."""


@command(app, RUN)
def simulate(
    scenario: Annotated[str | None, typer.Argument(metavar="SCENARIO", autocompletion=complete_scenarios)] = None,
    seed: Seed = None,
    seeds: Annotated[str | None, typer.Option(metavar="A:B")] = None,
    seconds: Seconds = None,
    runs: Runs = Path("runs"),
    trace: Path | None = None,
    force: Force = False,
    as_json: AsJson = False,
) -> int:
    """Simulate a scenario in one process, faster than real time.

    It leaves the same folder as `swarm up`.

    swarm simulate jacksboro --seed 7 --seconds 60 --trace events.log

    With --seeds, processes crash and hang, links are cut, clocks jump, messages are lost, late and repeated.
    Without a name each seed takes the next of the small worlds. Exit code 1 if an invariant broke in any seed: by
    a collision, a lost mark or a vehicle without a route.

    swarm simulate --seeds 0:100

    swarm simulate doors --seeds 17:18

    scenario  A .toml file or a built-in name; with --seeds also small, wide, open, doors, corridor or maze.
    seed      Seed of everything random.
    seeds     Try the seeds A to B - 1, each with faults of every kind.
    seconds   Simulated seconds.
    trace     Write the event log here; the same seed writes the same log.
    """
    from launch_scripts.report.gis_formats import check_target

    if seeds is None:
        if scenario is None:
            raise ConfigError("give a SCENARIO, or --seeds A:B to try many seeds of small worlds")
        check_target(trace, "--trace", force=force)
        _simulate_once(scenario, seed, seconds, trace, runs, as_json)
        return 0
    if seed is not None or trace is not None:
        raise ConfigError("--seeds goes with neither --seed nor --trace")
    return int(not simulate_seeds(scenario, seeds, seconds, as_json))


def _simulate_once(
    name: str, seed: int | None, seconds: float | None, trace: Path | None, runs: Path, as_json: bool
) -> None:
    """Runs a scenario without faults, prints its report and leaves a run's folder in `runs`."""
    from launch_scripts.check.scenario_check import check_places
    from launch_scripts.launcher.console import Terminal, progress
    from launch_scripts.launcher.run_options import find_scenario, make_run_dir, new_run_id
    from launch_scripts.observe.run_folders import begin_run
    from launch_scripts.report.report_and_tracks import with_series, write_report
    from launch_scripts.simulation.sample_worlds import WORLDS
    from launch_scripts.simulation.simulate import Simulation, run_to_end

    if name in WORLDS:
        raise ConfigError(f"{name!r} is a small world, which goes with --seeds A:B; without it give a scenario")
    scenario = find_scenario(name)
    terminal = Terminal(as_json, plain=True)
    with contextlib.ExitStack() as stack:
        log = None
        if trace is not None:
            stack.enter_context(writing(trace))
            log = stack.enter_context(trace.open("w", encoding="utf-8", newline="\n"))
        scenario = msgspec.structs.replace(
            scenario,
            seed=scenario.seed if seed is None else seed,
            seconds=scenario.seconds if seconds is None else seconds,
        )
        # Before the folder is made: a scenario without its terrain or without places for its vehicles leaves none.
        done = Simulation(scenario, trace=log)
        check_places(scenario, done.terrain, done.truth)
        folder = done.record_to = make_run_dir(runs, f"{new_run_id()}-simulated")
        for sentence in begin_run(folder, scenario, folder.name, simulated=True):
            terminal.say(sentence, "yellow")
        with progress() as show:
            began_s = time.perf_counter()
            report = run_to_end(done, show)
            took_s = time.perf_counter() - began_s
    if as_json:
        numbers = {name: value for name, value in report.items() if name != "by_vehicle"}
        typer.echo(json.dumps(numbers, indent=2))
    else:
        terminal.report(report)
    report = with_series({**report, "run_id": folder.name}, done.recorder, done.terrain)
    write_report(folder, report, done.recorder, done.terrain, truth=done.truth)
    log_text = "" if trace is None else f"; event log in {trace}"
    terminal.say(
        f"{scenario.seconds:g} simulated seconds in {took_s:.1f} s: "
        f"{scenario.seconds / took_s:.1f} times real time, {done.deliveries:,} deliveries{log_text}"
    )
    terminal.say(f"report: {folder / 'report.html'}, numbers: {folder / 'report.json'}")


def simulate_seeds(name: str | None, seeds: str, seconds: float | None, as_json: bool) -> bool:
    """Runs many seeds with faults, and prints what they break. True if every law held in all of them."""
    from launch_scripts.launcher.run_options import find_scenario
    from launch_scripts.simulation.sample_worlds import WORLDS
    from launch_scripts.simulation.trials import MIX, SECONDS, Trial, parse_seeds, replay_of, run_trial, world_of

    some, name = parse_seeds(seeds), name or MIX
    given = None if name in (MIX, *WORLDS) else find_scenario(name)
    seconds = SECONDS if seconds is None else seconds
    failing, results = [], []
    for seed in some:
        trial = Trial("", world_of(name, seed), given, seed, seconds, True)
        result = run_trial(trial)
        results.append(result)
        if result.broken:
            again = replay_of(trial.world, seed, seconds, SECONDS)
            broken = list(map(str, result.broken))
            failing.append({"world": trial.world, "seed": seed, "broken": broken, "replay": again})
        typer.echo(f"{len(results)}/{len(some)} {_line(trial, result)}", err=as_json)
    figures = [result.figures for result in results]
    waits_s, routed_s = (
        max(each.get(figure, 0.0) for each in figures) for figure in ("longest_wait_s", "routed_after_s")
    )
    if as_json:
        total = {"seeds": len(some), "longest_wait_s": waits_s, "routed_after_s": routed_s, "failing": failing}
        typer.echo(json.dumps({**total, "results": msgspec.to_builtins(results)}, indent=2))
        return not failing
    faults = sum((Counter(each) for each in figures), Counter())
    text = ", ".join(
        f"{many:.0f} {name.removeprefix('faults.').replace('_', ' ')}"
        for name, many in faults.items()
        if name.startswith("faults.")
    )
    typer.echo(
        f"{number_of(len(some), 'seed')}, {len(some) * seconds:g} simulated seconds in "
        f"{sum(each.wall_s for each in results):.0f} s; {text}\n"
        f"longest wait without a reason {waits_s:.1f} s, all routed at most {routed_s:.2f} s after the last fault"
    )
    for failure in failing:
        typer.echo(f"failed: {failure['replay']}")
    typer.echo(f"{len(failing)} of {number_of(len(some), 'seed')} broke a law")
    return not failing


def _line(trial: Trial, result: Result) -> str:
    figures = result.figures
    routed = f"{figures['routed_after_s']:.2f} s" if "routed_after_s" in figures else "never"
    text = (
        f"{'FAILED' if result.broken else 'held  '} {trial.world} seed {trial.seed}: "
        f"longest wait {figures['longest_wait_s']:.1f} s, routed after {routed}, "
        f"{number_of(round(figures.get('captures', 0)), 'capture')}, {result.wall_s:.0f} s"
    )
    return "\n".join([text, *(f"    {law}" for law in result.broken)])


@command(study_app)
def run(
    study: Annotated[str, typer.Argument(metavar="STUDY")],
    scheduler: Annotated[str | None, typer.Option(metavar="ADDRESS")] = None,
    workers: Annotated[int | None, typer.Option(min=1, max=1024)] = None,
    out: Path | None = None,
    as_json: AsJson = False,
) -> int:
    """Run a study: scenarios x settings x seeds, on many processes or machines.

    A second start, also with other seeds or settings, runs only the missing trials. Exit code 1 if an invariant
    broke in any trial, or if a trial has no result. It needs the extra "sweep".

    swarm study run study.toml

    swarm study run study.toml --scheduler tcp://127.0.0.1:8786 --out results

    study      A .toml file, or a built-in name.
    scheduler  An existing cluster of Dask.
    workers    Processes of this machine. Default: one per core.
    out        Folder of the results. Default: sweeps/NAME of the study.
    """
    from rich.console import Console

    if scheduler is not None and workers is not None:
        raise ConfigError("--workers goes without --scheduler: the workers of that cluster are used")
    if scheduler is not None and re.fullmatch(_SCHEDULER, scheduler) is None:
        raise ConfigError(
            f"--scheduler: found {quoted(scheduler)}, expected an address such as tcp://127.0.0.1:8786"
        )
    from dask.system import CPU_COUNT

    from launch_scripts.simulation.study import METHOD, outcome_table, study_path
    from launch_scripts.simulation.study_sweep import NUMBERS, RESULTS, Sweep

    sweep = Sweep(study_path(study), out)
    console = Console(stderr=True, highlight=False, soft_wrap=True, markup=False, emoji=False)
    kept = sweep.trials - len(sweep.missing)
    if kept:
        console.print(f"{kept:,} of {sweep.trials:,} trials are kept from before in {sweep.folder}")
    try:
        # SIGTERM, too, as a batch system or `timeout` ends a sweep: workers and their folder go with it.
        with stop_requests() as stopping:
            _run(sweep, console, workers or CPU_COUNT, scheduler, stopping)
    except KeyboardInterrupt:
        there = sum(trial.key in sweep.store.results for trial in sweep.missing) + kept
        with contextlib.suppress(KeyboardInterrupt):
            console.print(f"{there:,} of {sweep.trials:,} trials are kept in {sweep.folder}; start again to go on")
        raise
    summary = sweep.finish()
    if as_json:
        typer.echo((sweep.folder / NUMBERS).read_text(encoding="utf-8"))
        return int(bool(summary.failing or summary.missing))
    for name in summary.cases[0].outcomes:
        typer.echo(f"{name}\n{outcome_table(summary, name)}\n")
    for failure in summary.failing[:_SHOWN_FAILURES]:
        typer.echo(f"failed: {failure.replay}")
    missing = f"; {summary.missing:,} have no result" if summary.missing else ""
    typer.echo(f"{len(summary.failing):,} of {summary.trials:,} trials broke a law{missing}")
    typer.echo(f"{METHOD}\nsummary: {sweep.folder / NUMBERS}, results: {sweep.folder / RESULTS}")
    return int(bool(summary.failing or summary.missing))


def _run(sweep: Sweep, console: Console, workers: int, scheduler: str | None, stopping: Callable[[], bool]) -> None:
    from launch_scripts.launcher.console import progress

    failed, done = 0, sweep.trials - len(sweep.missing)
    with progress() as show:

        def on_result(trial: Trial, result: Result | None) -> None:
            nonlocal failed, done
            done += 1
            failed += bool(result is not None and result.broken)
            for law in result.broken[:1] if result is not None else ():
                console.print(f"{trial.world} seed {trial.seed} broke a law: {law}")
            if result is None:
                console.print(f"{trial.world} seed {trial.seed} is given up: each worker that ran it died")
            show(f"{done:,} of {sweep.trials:,} trials, {failed:,} broke a law", done / sweep.trials)
            if stopping():
                raise KeyboardInterrupt

        sweep.run(workers, scheduler, on_result)
