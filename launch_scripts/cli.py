"""The command `swarm`. Each sub-command imports what it needs when it runs, so that --help is quick."""

from __future__ import annotations

import errno
import importlib
import os
import signal
import sys
import time
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import typer

from launch_scripts.commands import query, roles
from launch_scripts.commands.orders import orders
from launch_scripts.commands.shared_options import AsJson, Namespace, RunOptions, Runs, Tls, spread
from swarm.errors import StoreError, SwarmError
from swarm.ranks import HIGHEST_RANK


def _began_s() -> float:
    """Start of this process on the monotonic clock, so that imports count as start-up time."""
    try:
        ticks = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
        age_s = time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError, AttributeError):  # not Linux
        age_s = 0.0
    return time.monotonic() - age_s


app = typer.Typer(
    name="swarm",
    help="""A swarm of vehicles chases moving targets over real terrain.

For every target a planner keeps the tree of cheapest paths to it; vehicles
follow their routes and mark what the map did not know; all meet on Zenoh.

    swarm demo                         the whole swarm, for a minute

    swarm up my.toml --port 0          your scenario, on free ports

    swarm status                       who takes part in a running swarm

    swarm route --target t3 --row 40 --col 200

    swarm simulate jacksboro --seed 7  in one process, faster than real time
""",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

ScenarioArgument = Annotated[
    str,
    typer.Argument(metavar="SCENARIO", help="A .toml file, or the name of a built-in scenario such as jacksboro."),
]


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


@app.command()
@spread
def demo(run: RunOptions) -> None:
    """Run the whole swarm on real mountains: 100 vehicles, 10 targets, 18 processes.

    The same as `swarm up jacksboro`. Stops after --seconds, or on Ctrl-C, and leaves runs/RUN/ with run.rrd,
    report.json, report.png and a log file per process.
    """
    _up("jacksboro", run)


@app.command()
@spread
def up(
    scenario: ScenarioArgument,
    run: RunOptions,
    tls: Tls,
    connect: Annotated[
        str | None,
        typer.Option(help="Join a router that runs elsewhere, such as tcp/127.0.0.1:7447; start none here."),
    ] = None,
    listen: Annotated[
        str | None,
        typer.Option(help="Where the router listens too, for other machines, such as tls/0.0.0.0:7448."),
    ] = None,
    only: Annotated[
        list[str] | None, typer.Option(help="Start only this role; may be given several times.")
    ] = None,
    rank: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=HIGHEST_RANK,
            help="Of planners and the targets process, start those of this rank: 0 lead, 1 stand by, and so on.",
        ),
    ] = None,
    run_id: Annotated[
        str | None, typer.Option(help="Take part in this run; by default a new one, or the one in the namespace.")
    ] = None,
    namespace: Namespace = None,
) -> None:
    """Run a scenario: all of its processes on this machine, or some of them.

    swarm up jacksboro --seconds 20 --port 0

    swarm up my.toml --only router --only keeper

    swarm up my.toml --connect tls/10.0.0.5:7447 --only planner --rank 1 --tls-ca ca.pem --tls-cert . --tls-key .

    swarm up my.toml --connect tls/10.0.0.5:7447 --only agent --tls-ca ca.pem --tls-cert me.pem --tls-key me.key
    """
    _up(
        scenario, run, tls, connect=connect, listen=listen, namespace=namespace, only=only, rank=rank, run_id=run_id
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
) -> None:
    from launch_scripts.launcher.preload import ROLES_AND_KERNELS, ROLES_ONLY, start_forkserver

    # Beside the imports below and the terrain, which take as long.
    start_forkserver(ROLES_AND_KERNELS if not only or "planner" in only else ROLES_ONLY)

    import msgspec

    from launch_scripts.launcher import options
    from launch_scripts.launcher.up import UpOptions, run_swarm
    from launch_scripts.process_table import ROLES
    from swarm.errors import ConfigError

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
    for role in only or ():
        if role not in ROLES:
            raise ConfigError(f"--only: no role {role!r}; the roles are {', '.join(ROLES)}")
    roles = tuple(role for role in ROLES if not only or role in only)
    if connect is not None:
        roles = tuple(role for role in roles if role != "router")
    chosen = UpOptions(
        scenario,
        run.runs,
        roles=roles,
        joins="router" not in roles,
        rank=rank,
        run_id=run_id,
        as_json=run.as_json,
        plain=run.plain,
        metrics_port=run.metrics_port,
        began_s=_began_s(),
        record_inputs=run.record_inputs,
    )
    raise typer.Exit(run_swarm(chosen))


@app.command()
def simulate(
    scenario: Annotated[
        str | None,
        typer.Argument(
            metavar="SCENARIO",
            help="A .toml file or a built-in name; with --seeds also a small world: small, wide, open, doors, "
            "corridor, maze. With --seeds and without a name each seed takes the next of these worlds.",
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
    from swarm.errors import ConfigError

    if seeds is None:
        if scenario is None:
            raise ConfigError("give a SCENARIO, or --seeds A:B to try many seeds of small worlds")
        simulate_once(scenario, seed, seconds, trace, runs, as_json)
        return
    if seed is not None or trace is not None:
        raise ConfigError("--seeds goes with neither --seed nor --trace")
    if not simulate_seeds(scenario, seeds, seconds, jobs, as_json):
        raise typer.Exit(1)


@app.command()
def chaos(
    scenario: Annotated[
        str, typer.Argument(metavar="SCENARIO", help="A .toml file, or the name of a built-in scenario.")
    ] = "besieged",
    seconds: Annotated[float | None, typer.Option(min=1, help="End after so many seconds.")] = None,
    messages: Annotated[
        int | None, typer.Option(min=1, help="End once so many hostile messages have been sent.")
    ] = None,
    blow: Annotated[
        list[str] | None, typer.Option(help="Only this: kill, hang or messages; may be given several times.")
    ] = None,
    hostile: Annotated[
        list[str] | None,
        typer.Option(help="Only these messages: flipped, numbers, replayed or lies; may be given several times."),
    ] = None,
    spare: Annotated[
        list[str] | None, typer.Option(help="Say nothing hostile under this topic; may be given several times.")
    ] = None,
    every: Annotated[float, typer.Option(min=1, help="Seconds from one blow to the next, at least.")] = 10.0,
    within: Annotated[
        float, typer.Option(min=0.1, help="Recovering later than so many seconds breaks a law.")
    ] = 10.0,
    seed: Annotated[int, typer.Option(min=0, max=2**53, help="Decides the blows and their order.")] = 1,
    runs: Runs = Path("runs"),
    as_json: AsJson = False,
) -> None:
    """Start a swarm on this machine, strike it, and measure how soon it recovers.

    Processes are killed (kill -9 of one or two) or stopped for a while, and messages are said with flipped bits,
    hostile numbers, replayed, or as well-formed lies. Lasts a minute unless --seconds or --messages say more. Exit
    code 1 if a process ended by itself, vehicles did not recover in time or met, or memory grew. Leaves chaos.json
    and chaos.png in the run's folder.

    swarm chaos --seconds 60

    swarm chaos --blow kill --every 10 --seconds 3600

    swarm chaos --blow messages --messages 1000000
    """
    from launch_scripts.chaos.blows import BLOWS
    from launch_scripts.chaos.hostile import KINDS
    from launch_scripts.chaos.siege import SiegeOptions
    from launch_scripts.commands import chaos as command
    from swarm.wire.topics import TOPICS

    if seconds is None and messages is None:
        seconds = 60.0
    options = SiegeOptions(
        scenario=scenario,
        seconds=seconds,
        messages=messages,
        seed=seed,
        every_s=every,
        kinds=command.check_kinds("--blow", blow, BLOWS),
        hostile=command.check_kinds("--hostile", hostile, KINDS),
        spared=command.check_kinds("--spare", spare, tuple(topic.name for topic in TOPICS)) if spare else (),
        within_s=within,
        runs=runs,
    )
    if not command.chaos(options, as_json):
        raise typer.Exit(1)


@app.command()
def compare(
    run: Annotated[list[str], typer.Argument(metavar="RUN...", help="Folders of runs, or their names in --runs.")],
    runs: Runs = Path("runs"),
    as_json: AsJson = False,
) -> None:
    """Show what differs between runs: settings, versions and machines, and all figures beside each other.

    Where a run listened is left out: free ports differ each time.

    swarm compare 20261122-154115-44bb LAST
    """
    from launch_scripts.commands.compare import compare_runs

    compare_runs(run, runs, as_json)


app.add_typer(roles.app)
app.add_typer(query.app)
app.add_typer(orders.app)


MOUNTED: dict[str, str] = {}
"""Name -> module of each sub-command which has sub-commands of its own."""


@app.command()
def replay(
    run: Annotated[
        str, typer.Argument(metavar="RUN", help="A run's folder, its name in --runs, or LAST.")
    ] = "LAST",
    process: Annotated[str | None, typer.Option(help="Only this process, such as planner-t3.")] = None,
    until: Annotated[
        float | None, typer.Option(min=0, help="Only so many seconds from the start of the run, by its own clock.")
    ] = None,
    keep: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Copy what is replayed into a folder: a test case.")
    ] = None,
    runs: Runs = Path("runs"),
    as_json: AsJson = False,
) -> None:
    """Feed what the processes of a run heard to the services of this build, and say where their outputs first
    differ.

    swarm demo --record-inputs, then swarm replay

    swarm replay LAST --process planner-t3 --until 34.5 --keep my-case

    A simulated run is always recorded. Exit code 1 if any output differs or a recording cannot be replayed.
    """
    from launch_scripts.commands.replay import replay_one

    if not replay_one(run, runs, process, until, keep, as_json):
        raise typer.Exit(1)


def _mount(name: str, module: str, help: str) -> None:
    """Adds a sub-command whose own typer app is imported when it is called."""

    def forward(ctx: typer.Context) -> None:
        sub_app: Any = importlib.import_module(module).app
        sub_app(args=ctx.args, prog_name=f"swarm {name}")

    forward.__doc__ = help
    MOUNTED[name] = module
    app.command(
        name,
        context_settings={"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []},
        add_help_option=False,
    )(forward)


_mount(
    "bench", "launch_scripts.bench.cli", "Measure: the paper's tables, scale, the wire. See `swarm bench --help`."
)
_mount("terrain", "launch_scripts.commands.terrain.terrain", "Look at terrains. See `swarm terrain --help`.")
_mount("map", "launch_scripts.commands.map", "Look at shared maps and the keeper's store. See `swarm map --help`.")
_mount("report", "launch_scripts.commands.report", "What runs have left. See `swarm report --help`.")
_mount("zone", "launch_scripts.commands.orders.zone", "Close areas while the swarm runs. See `swarm zone --help`.")
_mount(
    "target", "launch_scripts.commands.orders.target", "Add, move and remove targets. See `swarm target --help`."
)
_mount(
    "vehicle", "launch_scripts.commands.orders.guests", "Add, remove and stop vehicles. See `swarm vehicle --help`."
)
_mount(
    "plugins", "launch_scripts.commands.plugins", "Your own sensors, walks, and so on. See `swarm plugins --help`."
)
_mount(
    "deploy",
    "launch_scripts.commands.deploy",
    "Certificates and zenohd, for several machines. See `swarm deploy --help`.",
)


def main() -> int:
    """Runs the command. A SwarmError becomes one sentence and its exit code, never a traceback."""
    # A shell starts what it puts into the background deaf to SIGINT. Whoever sends it means it.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        try:
            app(prog_name="swarm")
        finally:
            sys.stdout.flush()
    except SwarmError as error:
        print(f"swarm: {error}", file=sys.stderr)
        return error.exit_code
    except BrokenPipeError:
        _leave_output()
        return 0
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG) or error.filename is not None:
            raise
        _leave_output()
        print(f"swarm: cannot write the output: {error.strerror}", file=sys.stderr)
        return StoreError.exit_code
    return 0


def _leave_output() -> None:
    """Send what still waits to be printed nowhere: the interpreter would complain about it at its end."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.close(nowhere)
