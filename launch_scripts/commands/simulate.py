"""`swarm simulate`: one run in one process, or many seeds with everything going wrong at once."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from launch_scripts.simulation.trial import Verdict


def simulate_once(
    name: str, seed: int | None, seconds: float | None, trace: Path | None, runs: Path, as_json: bool
) -> None:
    """Run a scenario without faults, print its report and leave a run's folder in `runs`."""
    import msgspec

    from launch_scripts.launcher.console import Terminal
    from launch_scripts.launcher.options import find_scenario, make_run_dir, new_run_id
    from launch_scripts.observe.run_folder import begin_run
    from launch_scripts.report.write_report import with_series, write_report
    from launch_scripts.simulation.simulate import simulate as run_simulation
    from launch_scripts.simulation.worlds import WORLDS
    from swarm.errors import ConfigError, StoreError

    if name in WORLDS:
        raise ConfigError(f"{name!r} is a small world, which goes with --seeds A:B; without it give a scenario")
    if trace is not None and not trace.parent.is_dir():
        raise StoreError(f"cannot write --trace {trace}: there is no folder {trace.parent}")
    scenario = find_scenario(name)
    terminal = Terminal(as_json, plain=True)
    with contextlib.ExitStack() as stack:
        try:
            log = None if trace is None else stack.enter_context(trace.open("w", encoding="utf-8", newline="\n"))
        except OSError as error:
            raise StoreError(f"cannot write {trace}: {error.strerror or error}") from error
        scenario = msgspec.structs.replace(
            scenario,
            seed=scenario.seed if seed is None else seed,
            seconds=scenario.seconds if seconds is None else seconds,
        )
        folder = make_run_dir(runs, f"{new_run_id()}-simulated")
        for sentence in begin_run(folder, scenario, folder.name):
            terminal.say(sentence, "yellow")
        result = run_simulation(scenario, trace=log, record_to=folder)
    if as_json:
        numbers = {name: value for name, value in result.report.items() if name != "by_vehicle"}
        typer.echo(json.dumps(numbers, indent=2))
    else:
        terminal.report(result.report)
    report = with_series({**result.report, "run_id": folder.name}, result.recorder, result.terrain)
    write_report(folder, report, result.recorder, result.terrain, truth=result.truth)
    terminal.say(
        f"{result.seconds:g} simulated seconds in {result.wall_s:.1f} s: {result.speed:.1f} times real time, "
        f"{result.deliveries:,} deliveries" + ("" if trace is None else f"; event log in {trace}")
    )
    terminal.say(f"report: {folder / 'report.html'}, numbers: {folder / 'report.json'}")
    if result.trace_cut is not None:
        raise StoreError(f"the event log {trace} has no end: {result.trace_cut}")


def simulate_seeds(name: str | None, seeds: str, seconds: float | None, jobs: int, as_json: bool) -> bool:
    """Run many seeds with faults, and print what they break. True if every law held in all of them."""
    from launch_scripts.launcher.options import find_scenario
    from launch_scripts.simulation.campaign import MIX, parse_seeds, run_seeds
    from launch_scripts.simulation.trial import SECONDS
    from launch_scripts.simulation.worlds import WORLDS

    some = parse_seeds(seeds)
    name = MIX if name is None else name
    given = None if name in (MIX, *WORLDS) else find_scenario(name)
    began_s = time.monotonic()
    verdicts: list[Verdict] = []
    for verdict in run_seeds(name, some, jobs, SECONDS if seconds is None else seconds, given):
        verdicts.append(verdict)
        typer.echo(_line(verdict, len(verdicts), len(some)), err=as_json)
    verdicts.sort(key=lambda verdict: verdict.seed)
    total = _total(verdicts, time.monotonic() - began_s)
    if as_json:
        import msgspec

        typer.echo(json.dumps({**total, "verdicts": msgspec.to_builtins(verdicts)}, indent=2))
    else:
        _print_total(total)
    return not total["failing"]


def _line(verdict: Verdict, done: int, many: int) -> str:
    routed = "never" if verdict.routed_after_s is None else f"{verdict.routed_after_s:.2f} s"
    text = (
        f"{done}/{many} {'FAILED' if verdict.broken else 'held  '} {verdict.world} seed {verdict.seed}: "
        f"longest wait {verdict.longest_wait_s:.1f} s, routed after {routed}, {verdict.captures} captures, "
        f"{verdict.wall_s:.0f} s"
    )
    return "\n".join([text, *(f"    {law}" for law in verdict.broken)])


def _total(verdicts: Iterable[Verdict], wall_s: float) -> dict[str, Any]:
    verdicts = list(verdicts)
    faults: dict[str, int] = {}
    for verdict in verdicts:
        for kind, many in verdict.faults.items():
            faults[kind] = faults.get(kind, 0) + many
    return {
        "seeds": len(verdicts),
        "failing": [
            {
                "world": each.world,
                "seed": each.seed,
                "broken": [str(law) for law in each.broken],
                "replay": each.replay,
            }
            for each in verdicts
            if each.broken
        ],
        "longest_wait_s": max(each.longest_wait_s for each in verdicts),
        "routed_after_s": max(each.routed_after_s or 0.0 for each in verdicts),
        "simulated_s": sum(each.seconds for each in verdicts),
        "deliveries": sum(each.deliveries for each in verdicts),
        "faults": faults,
        "wall_s": wall_s,
    }


def _print_total(total: dict[str, Any]) -> None:
    faults = ", ".join(f"{many} {kind.replace('_', ' ')}" for kind, many in total["faults"].items())
    typer.echo(
        f"{total['seeds']} seeds, {total['simulated_s']:g} simulated seconds, {total['deliveries']:,} deliveries "
        f"in {total['wall_s']:.0f} s; {faults}"
    )
    typer.echo(
        f"longest wait without a reason {total['longest_wait_s']:.1f} s, all routed at most "
        f"{total['routed_after_s']:.2f} s after the last fault"
    )
    for failure in total["failing"]:
        typer.echo(f"failed: {failure['replay']}")
    typer.echo(f"{len(total['failing'])} of {total['seeds']} seeds broke a law")
