"""`swarm demo` and `swarm up`: all processes of a swarm on this machine, or some of them."""

from __future__ import annotations

import time

import msgspec
import typer

from launch_scripts.command_line import RUN, command
from launch_scripts.commands.shared_options import Meeting, RunOptions, ScenarioArgument, SomeProcesses

app = typer.Typer()


@command(app, RUN)
def demo(run: RunOptions) -> int:
    """Run the built-in example: 99 ground vehicles and a drone chase 10 targets.

    The same as `swarm up demo`. Ends after --seconds. Without it: a minute after the start-up, or later when the
    last live view closes. Ctrl-C ends it. Leaves runs/RUN/ with run.rrd, report.html, report.json, report.png and a
    log file per process.

    swarm demo --seconds 20 --port 0
    """
    return up("demo", run, Meeting(), SomeProcesses())


@command(app, RUN)
def up(scenario: ScenarioArgument, run: RunOptions, meeting: Meeting, part: SomeProcesses) -> int:
    """Run a scenario: all of its processes on this machine, or some.

    swarm up jacksboro --seconds 20 --port 0

    swarm up my.toml --only router --only keeper

    swarm up my.toml --only router.1 --only planner.t3 --only planner.t0.r1 --only agent

    swarm up my.toml --connect tls/10.0.0.5:7447 --only planner --rank 1 --tls-dir .
    """
    if run.detach:
        from launch_scripts.commands.runs_commands import in_background

        return in_background(as_json=run.as_json)
    from launch_scripts.launcher.forkserver import ROLES_AND_KERNELS, ROLES_ONLY, start_forkserver

    # Beside the imports below and the terrain, which take as long. `entry` has done so where it could.
    named = {word.partition(".")[0] for word in part.only or ()}
    start_forkserver(ROLES_AND_KERNELS if not named or "planner" in named else ROLES_ONLY)

    from launch_scripts.launcher import run_options
    from launch_scripts.launcher.up import run_swarm
    from launch_scripts.process_table import ROLES

    chosen = run_options.find_scenario(scenario)
    if run.port is not None:
        chosen = run_options.with_port(chosen, run.port)
    chosen = run_options.with_network(
        chosen,
        connect=meeting.connect,
        also_listen=meeting.listen,
        namespace=meeting.namespace,
        tls=meeting.tls(),
    )
    chosen = msgspec.structs.replace(
        chosen,
        seconds=chosen.seconds if run.seconds is None else run.seconds,
        seed=chosen.seed if run.seed is None else run.seed,
        monitor=msgspec.structs.replace(chosen.monitor, live=chosen.monitor.live and not run.no_live),
    )
    joins = meeting.connect is not None or (bool(named) and "router" not in named)
    return run_swarm(
        run_options.UpOptions(
            chosen,
            run.runs,
            run_options.chosen_processes(chosen, part.only or ROLES, part.rank, joins=joins),
            joins=joins,
            run_id=part.run_id,
            as_json=run.as_json,
            plain=run.plain,
            metrics_port=run.metrics_port,
            signals_address=run.signals_address,
            log_format=run.log_format,
            began_s=_began_s(),
            record_inputs=run.record_inputs,
            takes_over=part.take_over,
            stays_watched=scenario == "demo" and run.seconds is None,
        )
    )


def _began_s() -> float:
    """Start of this process on the monotonic clock, so that imports count as start-up time."""
    import psutil

    began_s: float = psutil.Process().create_time()
    return time.monotonic() - max(time.time() - began_s, 0.0)
