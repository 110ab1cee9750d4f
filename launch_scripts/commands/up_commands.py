"""`swarm demo` and `swarm up`: all processes of a swarm on this machine, or some of them."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import msgspec
import typer

from launch_scripts.commands import shared_options
from launch_scripts.typer_commands import NETWORK, PART, RUN, command
from swarm.peers import HIGHEST_RANK

app = typer.Typer()


@dataclass(frozen=True)
class RunOptions:
    """Start and display of a run: `swarm demo` and `swarm up`.

    seconds        How long the run lasts once the swarm is up.
    seed           Seed of everything random.
    no_live        Serve no live view. The run is recorded all the same.
    record_inputs  Record all input of every process, so that `swarm runs replay` can repeat the run.
    metrics_port   Serve metrics to Prometheus, and health to probes, on this port; 0 picks one.
    plain          Plain lines instead of the live table.
    detach         Run in the background: return once all processes run and a route was served. `swarm down` ends
                   it.
    """

    panel: ClassVar[str | None] = None
    seconds: shared_options.Seconds = None
    seed: shared_options.Seed = None
    runs: shared_options.Runs = Path("runs")
    port: shared_options.PortOption = None
    no_live: bool = False
    record_inputs: bool = False
    metrics_port: Annotated[int | None, typer.Option(min=0, max=shared_options.HIGHEST_PORT)] = None
    signals_address: shared_options.SignalsAddress = "127.0.0.1"
    log_format: shared_options.LogFormatOption = "text"
    plain: bool = False
    detach: Annotated[bool, typer.Option("--detach", "-d")] = False
    as_json: shared_options.AsJson = False


@dataclass(frozen=True)
class Meeting(shared_options.Tls):
    """Endpoints where the processes of a launcher meet others.

    connect  Join a router that runs elsewhere, such as tcp/127.0.0.1:7447; start none here.
    listen   Further endpoint of the router, for other machines, such as tls/0.0.0.0:7448.
    """

    panel: ClassVar[str | None] = NETWORK
    connect: str | None = None
    listen: str | None = None
    namespace: shared_options.Namespace = None


@dataclass(frozen=True)
class SomeProcesses:
    """Part of a swarm that a launcher starts, and its run.

    only       Start only this role or process: planner, planner.t0.r1; may be given several times.
    rank       Start planners and targets processes of this rank only; 0 is the leader, 1 the first standby.
    run_id     Take part in this run. By default a new one; of some processes, that of --connect, else one named
               after the scenario, which later starts continue.
    take_over  Take over from the launcher that runs this part here, as for an upgrade.
    """

    panel: ClassVar[str | None] = PART
    only: Annotated[list[str] | None, typer.Option(metavar="ROLE[.ID]")] = None
    rank: Annotated[int | None, typer.Option(min=0, max=HIGHEST_RANK)] = None
    run_id: str | None = None
    take_over: bool = False


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
def up(scenario: shared_options.ScenarioArgument, run: RunOptions, meeting: Meeting, part: SomeProcesses) -> int:
    """Run a scenario: all of its processes on this machine, or some.

    swarm up jacksboro --seconds 20 --port 0

    swarm up my.toml --only router --only keeper

    swarm up my.toml --only router.1 --only planner.t3 --only planner.t0.r1 --only agent

    swarm up my.toml --connect tls/10.0.0.5:7447 --only planner --rank 1 --tls-dir .
    """
    if run.detach:
        from launch_scripts.commands.ps_down_logs_commands import in_background

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
        chosen, connect=meeting.connect, also_listen=meeting.listen, namespace=meeting.namespace, tls=meeting.tls()
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
