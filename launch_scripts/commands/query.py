"""Sub-commands that ask a running swarm."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from launch_scripts.command_line import complete, panels
from launch_scripts.commands.shared_options import AsJson, PresetOption, SignalsAddress, Tls, spread
from swarm.places import written

if TYPE_CHECKING:
    from launch_scripts.commands.running.status import Status
    from swarm.config.scenario import NetworkConfig

app = typer.Typer()

_CONNECT_S = 3.0
_STATUS_LISTEN_S, _STATUS_MOST_S = 1.5, 4.0
"""`swarm status` listens for so long; longer while a process that has answered has not said how it is."""


@dataclass(frozen=True)
class Where:
    """Router and namespace of the swarm that a command asks."""

    connect: Annotated[
        str | None,
        typer.Option(
            help="The router's endpoint; if not given, that of the newest run here, or tcp/127.0.0.1:7447.",
            rich_help_panel=panels.NETWORK,
        ),
    ] = None
    namespace: Annotated[
        str | None,
        typer.Option(
            help="Prefix of all keys; if not given, that of the run, or `swarm`.", rich_help_panel=panels.NETWORK
        ),
    ] = None
    run: Annotated[
        str | None,
        typer.Option(
            help="The run to ask, where several run here: its name in --runs, or its folder.",
            rich_help_panel=panels.NETWORK,
        ),
    ] = None
    runs: Annotated[
        Path, typer.Option(help="Folder of the runs of this machine.", rich_help_panel=panels.NETWORK)
    ] = Path("runs")

    @cached_property
    def _found(self) -> NetworkConfig:
        from launch_scripts.commands.running.find_swarm import check_alone, find_swarm
        from swarm.config.scenario import NetworkConfig

        check_alone(self.connect, self.run)
        if self.connect is not None:
            return NetworkConfig()
        found = find_swarm(self.runs, self.run)
        if found.others:
            told = ", ".join(found.others[:3])
            typer.echo(f"asking run {found.run}, the newest; also running: {told} (--run NAME)", err=True)
        return found.network

    def network(self, tls: Tls) -> NetworkConfig:
        import msgspec

        from launch_scripts.launcher.options import as_process, with_network
        from launch_scripts.process_table import LAUNCHER
        from swarm.config.scenario import Scenario

        chosen = with_network(
            msgspec.structs.replace(Scenario(), network=self._found),
            connect=self.connect,
            namespace=self.namespace,
            tls=tls.config(),
        )
        network = as_process(chosen, LAUNCHER, "0").network
        return msgspec.structs.replace(network, connect_timeout_s=_CONNECT_S)

    def __str__(self) -> str:
        endpoint = self.connect or ", ".join(self._found.connect)
        return f"in namespace {(self.namespace or self._found.namespace)!r} at {endpoint}"


@app.command(rich_help_panel=panels.ASK)
@spread
def route(
    where: Where,
    tls: Tls,
    target: Annotated[
        str | None, typer.Option(help="The target, such as t3.", autocompletion=complete.target_ids)
    ] = None,
    row: Annotated[int | None, typer.Option(help="Row of the start, counted from the north.")] = None,
    col: Annotated[int | None, typer.Option(help="Column of the start, counted from the west.")] = None,
    steps: Annotated[int, typer.Option(min=0, help="Most steps to show; 1 is the next, 0 is all.")] = 0,
    cost: Annotated[bool, typer.Option("--cost", help="Only the cost, or that there is no way.")] = False,
    terrain: Annotated[
        str | None, typer.Option(help="Without a swarm: on this terrain file, scenario or built-in scenario.")
    ] = None,
    start: Annotated[
        str | None,
        typer.Option(
            "--from", metavar="PLACE", help="LAT,LON, xy:X,Y in metres or cell:ROW,COL; instead of --row and --col."
        ),
    ] = None,
    end: Annotated[
        str | None, typer.Option("--to", metavar="PLACE", help="With --terrain: where to, as --from.")
    ] = None,
    vehicle_class: Annotated[
        str, typer.Option("--class", help="Which class of the swarm's vehicles drives there.")
    ] = "ground",
    out: Annotated[
        Path | None,
        typer.Option(help="Write .geojson, .gpkg, .gpx, .kml or .csv; with --terrain also .png, a picture."),
    ] = None,
    preset: PresetOption = None,
    as_json: AsJson = False,
) -> None:
    """Ask a planner for the cheapest route from a place to its target; or find one on a terrain, without a swarm.

    swarm route --target t3 --row 40 --col 200

    swarm route --target t3 --from 36.41,-84.29 --steps 1

    swarm route --target t3 --row 40 --col 200 --json | jq .routes[0].cost_s

    swarm route --terrain dem.tif --from 46.81,9.84 --to 46.78,9.87 --preset hiker --out way.gpx
    """
    from launch_scripts.commands.routes.route_files import check_route_file
    from swarm.errors import ConfigError
    from swarm.places import read_place

    if terrain is not None:
        if start is None or end is None or target is not None or row is not None or col is not None:
            raise ConfigError("--terrain finds a route without a swarm: give --from and --to, and no --target")
        check_route_file(out)
        _route_on_terrain(terrain, start, end, preset, out, as_json)
        return
    if preset is not None:
        raise ConfigError("--preset goes with --terrain: planners of a running swarm go by its scenario")
    by_cell = row is not None and col is not None
    if target is None or (start is None) == (not by_cell) or end is not None or (cost and out is not None):
        raise ConfigError(
            "give --target, --row and --col (or --from) to ask a swarm, or --terrain, --from and --to without one"
        )
    check_route_file(out)
    place = read_place(f"cell:{row},{col}" if start is None else start, "--from")
    from launch_scripts.commands.routes import swarm_route

    network = where.network(tls)
    answer = swarm_route.ask_planner(
        network, where, target, place, cost=cost, steps=steps, vehicle_class=vehicle_class
    )
    if out is not None:
        swarm_route.write(answer, out)
    if as_json:
        typer.echo(swarm_route.as_json(answer))
    else:
        swarm_route.show(answer)


def _route_on_terrain(
    terrain: str, start: str, end: str, preset: str | None, out: Path | None, as_json: bool
) -> None:
    from launch_scripts.commands.routes.route_files import profile_of, write_route
    from launch_scripts.commands.terrain.route_on_terrain import find_route
    from shared_map.terrain.places import MapFrame

    found = find_route(terrain, start, end, preset)
    if out is not None:
        write_route(found, out)
    facts = found.facts()
    if as_json:
        typer.echo(json.dumps(facts))
        return
    frame = MapFrame(found.grid)
    typer.echo(f"from {written(frame, int(found.cells[0]))}")
    typer.echo(f"to {written(frame, int(found.cells[-1]))}")
    # A route from a place to itself takes no time, which is the optimum.
    above, climbed = (
        max(found.gap - 1, 0) if found.cost_s > 0 else 0.0,
        f"{facts['up_m']:.0f} m up and {facts['down_m']:.0f} m down",
    )
    typer.echo(f"{facts['length_m']:.0f} m in {facts['cost_s']:.0f} s, {climbed}, {facts['steps']} cells")
    typer.echo(f"proven to be at most {above:.2%} above the optimum")
    typer.echo(profile_of(found))


@app.command(rich_help_panel=panels.ASK)
@spread
def status(where: Where, tls: Tls, as_json: AsJson = False) -> None:
    """Show how a running swarm is: its figures, who takes part, its targets, and what went wrong.

    Without --connect it asks the newest run of this machine that runs, whatever its ports.

    swarm status

    swarm status --json | jq .planners
    """
    from rich.console import Console

    from launch_scripts.commands.running.status import print_status, status_fields

    told = ask_status(where, tls)
    if as_json:
        typer.echo(json.dumps(status_fields(told), indent=2))
    else:
        print_status(told, Console(markup=False))


def ask_status(where: Where, tls: Tls) -> Status:
    """A running swarm as it is now. Raises BusError if nobody answers."""
    from launch_scripts.commands.running.status import status_of
    from launch_scripts.observe.run_observer import OutsideObserver
    from swarm.bus.zenoh_bus import open_bus
    from swarm.clock import MonotonicClock
    from swarm.errors import BusError

    clock = MonotonicClock()
    with open_bus(where.network(tls)) as bus:
        observer = OutsideObserver(bus)
        began_s = time.monotonic()
        while (spent_s := time.monotonic() - began_s) < _STATUS_MOST_S:
            if spent_s >= _STATUS_LISTEN_S and observer.whole:
                break
            observer.listen(clock, 0.1)
        told = status_of(observer, clock.now_ns())
    if told is None:
        admitted = "" if tls.tls_ca is None else ", and does the router admit this certificate"
        raise BusError(f"nobody answers {where}: is the swarm running{admitted}?")
    return told


@app.command(rich_help_panel=panels.ASK)
@spread
def top(
    where: Where,
    tls: Tls,
    each: Annotated[bool, typer.Option("--each", help="A line for each process, not only for each role.")] = False,
    once: Annotated[bool, typer.Option("--once", help="Show it once and end.")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object a second, or one with --once.")
    ] = False,
) -> None:
    """Watch a running swarm: processes, vehicles and targets, once a second; `q` or Ctrl-C ends it.

    Processes on other machines are shown, too: each tells what it takes up. CPU of 100 % is one core; late/s counts
    ticks that came late or not at all, of a role the worst.

    swarm top --each

    swarm top --json --once | jq .processes[0]
    """
    from launch_scripts.commands.running.top import top as show

    show(where.network(tls), where, each=each, once=once, as_json=as_json)


@app.command(rich_help_panel=panels.ASK)
@spread
def metrics(
    where: Where,
    tls: Tls,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Where it listens; 0 picks one.")] = 9464,
    signals_address: SignalsAddress = "127.0.0.1",
    dashboard: Annotated[
        bool, typer.Option("--dashboard", help="Print a dashboard for Grafana, as JSON, and exit.")
    ] = False,
    alerts: Annotated[
        bool, typer.Option("--alerts", help="Print rules for alerts of Prometheus, as YAML, and exit.")
    ] = False,
) -> None:
    """Serve the figures of a running swarm to Prometheus, until Ctrl-C. It only listens.

    swarm metrics --port 9464

    swarm metrics --dashboard > swarm.json

    swarm metrics --alerts > swarm-alerts.yml

    `swarm up --metrics-port 9464` does the same for as long as the run lasts.
    """
    from launch_scripts.commands import metrics as command
    from swarm.errors import ConfigError

    if dashboard and alerts:
        raise ConfigError("--dashboard and --alerts print a file each: give one of them")
    if dashboard or alerts:
        typer.echo(command.dashboard() if dashboard else command.alerts(), nl=False)
    else:
        command.serve_metrics(where.network(tls), port, signals_address)


_ROS = "The ROS side"


@app.command(rich_help_panel=panels.ASK)
@spread
def ros2(
    where: Where,
    tls: Tls,
    settings: Annotated[
        Path | None, typer.Argument(metavar="[SETTINGS]", help="A .toml file: topics, rates, names, both sides.")
    ] = None,
    ros: Annotated[
        str | None,
        typer.Option(
            metavar="ENDPOINT",
            help="Router of the ROS side, rmw_zenohd; tcp/127.0.0.1:7447 if not given.",
            rich_help_panel=_ROS,
        ),
    ] = None,
    domain: Annotated[
        int | None, typer.Option(min=0, max=232, help="ROS_DOMAIN_ID; 0 if not given.", rich_help_panel=_ROS)
    ] = None,
    distribution: Annotated[
        str | None,
        typer.Option(help="humble, jazzy, kilted, lyrical or rolling; jazzy if not given.", rich_help_panel=_ROS),
    ] = None,
    vehicles: Annotated[
        list[str] | None,
        typer.Option(help="Ids of vehicles that ROS hears of, with * and ?; may be given several times."),
    ] = None,
    topics: Annotated[bool, typer.Option("--list", help="Print what is forwarded, and exit.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="With --list: as JSON.")] = False,
) -> None:
    """Show a running swarm to ROS 2 (rmw_zenoh), until Ctrl-C: map, transforms, odometry, plans, targets, markers.
    ROS need not be installed here.

    swarm ros2 --ros tcp/127.0.0.1:7447

    swarm ros2 gateway.toml --run LAST

    swarm ros2 --list
    """
    from launch_scripts.commands import ros2 as command

    chosen = command.settings_of(
        settings,
        {"ros.endpoint": ros, "ros.domain": domain, "ros.distribution": distribution, "vehicles": vehicles},
    )
    if topics:
        command.list_topics(chosen, as_json=as_json)
        return
    side = chosen.swarm
    where = replace(where, connect=where.connect or side.connect, namespace=where.namespace or side.namespace)
    tls = tls if tls.tls_ca else Tls(side.ca, side.certificate, side.key)
    command.serve_ros2(chosen, where.network(tls), where.runs)
