"""The command `swarm`. Each sub-command imports what it needs when it runs, so that --help is quick."""

from __future__ import annotations

import os
import time
from contextlib import nullcontext
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import typer

from launch_scripts.command_line import complete
from launch_scripts.command_line.families import CONTEXT, Family, rooted, worded
from launch_scripts.command_line.panels import ADMIN, LEFT, NETWORK, ORDER, PART, PREPARE, RUN
from launch_scripts.command_line.run_command import run_command
from launch_scripts.commands import afterwards, before, health, mavlink, query, roles
from launch_scripts.commands.orders import orders
from launch_scripts.commands.shared_options import (
    AsJson,
    Namespace,
    RunOptions,
    Runs,
    ScenarioArgument,
    Tls,
    spread,
)
from swarm.errors import ConfigError
from swarm.liveness import HIGHEST_RANK


def _began_s() -> float:
    """Start of this process on the monotonic clock, so that imports count as start-up time."""
    try:
        ticks = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
        age_s = time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError, AttributeError):  # not Linux
        age_s = 0.0
    return time.monotonic() - age_s


FAMILIES = [
    Family("terrain", "launch_scripts.commands.terrain.terrain", "Look at terrains, and find routes.", PREPARE),
    Family("plugins", "launch_scripts.commands.plugins", "Your own sensors, walks, and so on.", PREPARE),
    Family("map", "launch_scripts.commands.map", "Look at shared maps and the keeper's store.", LEFT),
    Family("zone", "launch_scripts.commands.orders.zone", "Close areas while the swarm runs.", ORDER),
    Family("target", "launch_scripts.commands.orders.target", "Add, move and remove targets.", ORDER),
    Family("vehicle", "launch_scripts.commands.orders.guests", "Add, remove and stop vehicles.", ORDER),
    Family(
        "deploy",
        "launch_scripts.commands.deploy",
        "A plan, certificates and configurations for several machines.",
        ADMIN,
    ),
]
"""Sub-commands which have sub-commands of their own, imported when they are called."""

app = typer.Typer(
    name="swarm",
    cls=rooted(FAMILIES),
    help="""A swarm of vehicles chases moving targets over real terrain.

For every target a planner keeps the tree of cheapest paths to it; vehicles
follow their routes and mark what the map did not know; all meet on Zenoh.

    swarm demo                         the whole swarm, for a minute

    swarm new my.toml                  asks, and writes a scenario of your own

    swarm check my.toml                what is wrong with it, before it runs

    swarm up my.toml --port 0          your scenario, on free ports

    swarm status                       who takes part in a running swarm

    swarm route --target t3 --row 40 --col 200

    swarm simulate jacksboro --seed 7  in one process, faster than real time

`swarm COMMAND -h` explains a command; `swarm --install-completion` lets the Tab key complete them.
""",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings=CONTEXT,
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"swarm {version('terrain-swarm')}")
        raise typer.Exit


@app.callback()
def _root(
    show_version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    pass


@app.command(rich_help_panel=RUN)
@spread
def demo(run: RunOptions) -> None:
    """Run the whole swarm on real mountains: 99 rovers, a drone, 10 targets, 19 processes.

    The same as `swarm up demo`. Stops after --seconds, or on Ctrl-C, and leaves runs/RUN/ with run.rrd,
    report.html, report.json, report.png and a log file per process.

    swarm demo --seconds 20 --port 0
    """
    _up("demo", run)


@app.command(rich_help_panel=RUN)
@spread
def up(
    scenario: ScenarioArgument,
    run: RunOptions,
    tls: Tls,
    connect: Annotated[
        str | None,
        typer.Option(
            help="Join a router that runs elsewhere, such as tcp/127.0.0.1:7447; start none here.",
            rich_help_panel=NETWORK,
        ),
    ] = None,
    listen: Annotated[
        str | None,
        typer.Option(
            help="Where the router listens too, for other machines, such as tls/0.0.0.0:7448.",
            rich_help_panel=NETWORK,
        ),
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ROLE[.ID]",
            help="Start only this role, or one process of it: planner, planner.t0.r1; may be given several times.",
            rich_help_panel=PART,
            autocompletion=complete.words("launch_scripts.process_table", "ROLES"),
        ),
    ] = None,
    rank: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=HIGHEST_RANK,
            help="Of planners and the targets process, start those of this rank: 0 lead, 1 stand by, and so on.",
            rich_help_panel=PART,
        ),
    ] = None,
    run_id: Annotated[
        str | None,
        typer.Option(
            help="Take part in this run; by default a new one, or the one in the namespace.", rich_help_panel=PART
        ),
    ] = None,
    take_over: Annotated[
        bool,
        typer.Option(
            "--take-over",
            help="Take over from the launcher that runs this part of the run here, as for an upgrade: it is ended "
            "once successors are ready.",
            rich_help_panel=PART,
        ),
    ] = False,
    namespace: Namespace = None,
) -> None:
    """Run a scenario: all of its processes on this machine, or some of them.

    swarm up jacksboro --seconds 20 --port 0

    swarm up my.toml --only router --only keeper

    swarm up my.toml --only router.1 --only planner.t3 --only planner.t0.r1 --only agent

    swarm up my.toml --connect tls/10.0.0.5:7447 --only planner --rank 1 --tls-ca ca.pem --tls-cert . --tls-key .

    swarm up my.toml --connect tls/10.0.0.5:7447 --only agent --tls-ca ca.pem --tls-cert me.pem --tls-key me.key
    """
    _up(
        scenario,
        run,
        tls,
        connect=connect,
        listen=listen,
        namespace=namespace,
        only=only,
        rank=rank,
        run_id=run_id,
        take_over=take_over,
    )


def _up(
    name: str,
    run: RunOptions,
    tls: Tls | None = None,
    *,
    connect: str | None = None,
    listen: str | None = None,
    namespace: str | None = None,
    only: list[str] | None = None,
    rank: int | None = None,
    run_id: str | None = None,
    take_over: bool = False,
) -> None:
    from launch_scripts.launcher.console import busy_loading
    from launch_scripts.launcher.forkserver import ROLES_AND_KERNELS, ROLES_ONLY, start_forkserver

    # Beside the imports below and the terrain, which take as long. `entry` has done so where it could.
    named = {word.partition(".")[0] for word in only or ()}
    start_forkserver(ROLES_AND_KERNELS if not named or "planner" in named else ROLES_ONLY)

    with busy_loading(as_json=run.as_json, plain=run.plain) if run.log_format == "text" else nullcontext():
        import msgspec

        from launch_scripts.launcher import options
        from launch_scripts.launcher.options import UpOptions, chosen_processes
        from launch_scripts.launcher.up import run_swarm
        from launch_scripts.process_table import ROLES

    scenario = options.find_scenario(name)
    if run.port is not None:
        scenario = options.with_port(scenario, run.port)
    scenario = options.with_network(
        scenario,
        connect=connect,
        also_listen=listen,
        namespace=namespace,
        tls=None if tls is None else tls.config(),
    )
    scenario = options.with_follow(scenario, run.follow)
    monitor = msgspec.structs.replace(scenario.monitor, live=scenario.monitor.live and not run.no_live)
    scenario = msgspec.structs.replace(
        scenario,
        seconds=scenario.seconds if run.seconds is None else run.seconds,
        seed=scenario.seed if run.seed is None else run.seed,
        monitor=monitor,
    )
    some = chosen_processes(scenario, only or (), rank)
    one_by_one = any("." in word for word in only or ())
    roles = tuple(role for role in ROLES if not named or role in named)
    if connect is not None:
        roles = tuple(role for role in roles if role != "router")
    chosen = UpOptions(
        scenario,
        run.runs,
        roles=roles,
        joins="router" not in roles,
        rank=rank,
        table=tuple(spec for spec in some if spec.role in roles) if one_by_one else None,
        run_id=run_id,
        as_json=run.as_json,
        plain=run.plain,
        metrics_port=run.metrics_port,
        signals_address=run.signals_address,
        log_format=run.log_format,
        began_s=_began_s(),
        record_inputs=run.record_inputs,
        takes_over=take_over,
    )
    raise typer.Exit(run_swarm(chosen))


@app.command(rich_help_panel=RUN)
def simulate(
    scenario: Annotated[
        str | None,
        typer.Argument(
            metavar="SCENARIO",
            help="A .toml file or a built-in name; with --seeds also a small world: small, wide, open, doors, "
            "corridor, maze. With --seeds and without a name each seed takes the next of these worlds.",
            autocompletion=complete.scenarios_and_worlds,
        ),
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, max=2**53, help="Seed of everything random.")] = None,
    seeds: Annotated[
        str | None, typer.Option(metavar="A:B", help="Try the seeds A to B - 1, each with faults of every kind.")
    ] = None,
    seconds: Annotated[float | None, typer.Option(min=0.1, help="Simulated seconds.")] = None,
    jobs: Annotated[int, typer.Option(min=1, max=256, help="With --seeds: seeds that run at the same time.")] = 1,
    runs: Runs = Path("runs"),
    trace: Annotated[
        Path | None, typer.Option(help="Write the event log here; the same seed writes the same log.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Run the same swarm in one process, on a memory bus and a manual clock, and leave the same folder.

    swarm simulate jacksboro --seed 7 --seconds 60 --trace events.log

    With --seeds, processes crash and hang, links are cut, also one way, clocks are set, agents run twice, messages
    are lost, late, repeated and out of order. Exit code 1 if a law broke in any seed: a collision, a lethal entry,
    an acknowledged mark lost, replicas that differ, a wait of ten seconds without a reason, a vehicle without a
    route.

    swarm simulate --seeds 0:100 --jobs 2

    swarm simulate doors --seeds 17:18
    """
    from launch_scripts.commands.simulate import simulate_once, simulate_seeds

    if seeds is None:
        if scenario is None:
            raise ConfigError("give a SCENARIO, or --seeds A:B to try many seeds of small worlds")
        simulate_once(scenario, seed, seconds, trace, runs, as_json)
        return
    if seed is not None or trace is not None:
        raise ConfigError("--seeds goes with neither --seed nor --trace")
    if not simulate_seeds(scenario, seeds, seconds, jobs, as_json):
        raise typer.Exit(1)


@app.command(rich_help_panel=RUN)
def sweep(
    study: Annotated[
        str,
        typer.Argument(
            metavar="STUDY",
            help="A .toml file with scenarios, settings and seeds, or a built-in name.",
            autocompletion=complete.studies,
        ),
    ],
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="A cluster of Dask that is there, such as tcp://127.0.0.1:8786."),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(min=1, max=1024, help="Processes of this machine; as many as it has cores if not given."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder of the results; sweeps/NAME of the study if not given.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Run a study: scenarios x settings x seeds through the simulation, over many processes or machines.

    Leaves results.parquet, summary.md and pictures in the folder. Results are kept as they come: started again,
    also with other seeds or settings, it runs what is missing only. Exit code 1 if a law broke in any trial.
    It needs the extra "sweep" (Dask, pyarrow).

    swarm sweep study.toml

    swarm sweep study.toml --scheduler tcp://127.0.0.1:8786 --out results
    """
    from launch_scripts.commands.sweep import sweep_study

    if not sweep_study(study, scheduler, workers, out, as_json):
        raise typer.Exit(1)


app.add_typer(before.app)
app.add_typer(afterwards.app)
app.add_typer(roles.app)
app.add_typer(query.app)
app.add_typer(health.app)
app.add_typer(orders.app)
app.add_typer(mavlink.app)


@cache
def command() -> Any:
    """The command with all of its sub-commands."""
    return worded(typer.main.get_command(app))


def main() -> int:
    """Runs the command. A SwarmError becomes one sentence and its exit code, never a traceback."""
    return run_command(command)
