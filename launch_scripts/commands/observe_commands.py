"""Commands that ask a running swarm: `route`, `status`, `top`, `health` and `metrics`."""

from __future__ import annotations

import json
import os
from importlib.resources import files
from pathlib import Path
from typing import Annotated

import typer

from launch_scripts.commands import shared_options
from launch_scripts.typer_commands import ASK, command
from swarm.errors import ConfigError

app = typer.Typer()
_TURN_S = 0.1
"""A scrape or Ctrl-C waits this long at most. Prometheus gives up after 10 s by default; shorter turns would cost
CPU without any query."""


@command(app, ASK)
def route(
    where: shared_options.Where,
    target: str | None = None,
    terrain: str | None = None,
    start: Annotated[str | None, typer.Option("--from", metavar="PLACE")] = None,
    end: Annotated[str | None, typer.Option("--to", metavar="PLACE")] = None,
    vehicle_class: shared_options.VehicleClass = "ground",
    out: Path | None = None,
    preset: shared_options.PresetOption = None,
    crs: shared_options.Crs = None,
    force: shared_options.Force = False,
    as_json: shared_options.AsJson = False,
) -> None:
    """Find the cheapest route to a target or a place of a running swarm, or on a terrain file.

    swarm route --from cell:40,200 --to 36.50,-84.29

    swarm route --target t3 --from cell:40,200

    swarm route --target t3 --from cell:40,200 --json | jq .routes[0].cost_s

    swarm route --terrain dem.tif --from 46.81,9.84 --to 46.78,9.87 --preset hiker --out way.gpx

    target         The target, such as t3.
    terrain        Without a swarm: on this terrain file, scenario or built-in scenario.
    start          LAT,LON, xy:X,Y in metres of the map, or cell:ROW,COL from the north-west.
    end            Instead of a target: the destination, in the same forms as --from.
    vehicle_class  Class of the vehicle.
    out            Write {layers}, .plan or .waypoints; with --terrain also .png.
    """
    from launch_scripts.commands import terrain_routes
    from launch_scripts.launcher.run_options import find_scenario
    from launch_scripts.report import FORMATS, MISSIONS
    from launch_scripts.report.gis_formats import check_target
    from swarm.places import read_place

    check_target(out, "--out", *FORMATS, *MISSIONS, ".png", force=force)
    if terrain is not None:
        if start is None or end is None or target is not None:
            lacks = [f"{name} is missing" for name, at in (("--from", start), ("--to", end)) if at is None]
            found = ", ".join(lacks) or "--target asks a swarm"
            raise ConfigError(f"{found}: --terrain finds a route without a swarm; give --from and --to")
        scenario = find_scenario(terrain, preset, crs)
        terrain_routes.print_route(terrain_routes.find_route(scenario, start, end), out, as_json)
        return
    if preset is not None or crs is not None:
        raise ConfigError("--preset and --crs go with --terrain: planners of a running swarm go by its scenario")
    if (target is None) == (end is None) or start is None:
        raise ConfigError("give --from with --target or --to, or give --terrain with --from and --to")
    place = read_place(start, "--from")
    from launch_scripts.commands import swarm_route

    goal = None if end is None else read_place(end, "--to")
    with where.bus() as bus:
        if goal is not None:
            answer = swarm_route.ask_place(bus, where, place, goal, vehicle_class)
        elif target is not None:
            answer = swarm_route.ask_planner(bus, where, target, place, vehicle_class)
    if out is not None:
        swarm_route.write(answer, out)
    if as_json:
        typer.echo(swarm_route.as_json(answer))
    else:
        swarm_route.show(answer)
        if out is not None:
            typer.echo(f"route: {out}")


@command(app, ASK)
def status(
    where: shared_options.Where,
    watch: bool = False,
    vehicles: bool = False,
    as_json: shared_options.AsJson = False,
) -> None:
    """Show a running swarm: metrics, processes, targets and alarms.

    Without --connect it asks the newest active run of this machine.

    swarm status

    swarm status --json | jq .planners

    swarm status --vehicles | grep stranded

    watch     Show processes once a second, as `swarm top`.
    vehicles  Show each vehicle instead: class, state, destination and place.
    """
    from launch_scripts.commands.status_view import ask_status, print_status, status_fields, vehicles_table
    from launch_scripts.launcher.console import whole_output

    if watch and vehicles:
        raise ConfigError("--watch shows processes, --vehicles shows vehicles: give one of them")
    if watch:
        top(where, as_json=as_json)
    elif vehicles and as_json:
        typer.echo(json.dumps({"vehicles": ask_status(where).vehicles()}, indent=2))
    elif vehicles:
        whole_output().print(vehicles_table(ask_status(where)))
    elif as_json:
        typer.echo(json.dumps(status_fields(ask_status(where)), indent=2))
    else:
        print_status(ask_status(where), whole_output())


@command(app, ASK)
def top(
    where: shared_options.Where,
    each: bool = False,
    once: bool = False,
    as_json: Annotated[bool, typer.Option("--json")] = False,
) -> None:
    """Watch a running swarm, once a second; Ctrl-C ends it.

    Processes on other machines are included. CPU of 100 % is one core; late/s counts ticks that came late or not at
    all; a role shows its worst process.

    swarm top --each

    swarm top --json --once | jq .processes[0]

    each     Print a line for each process, not for each role.
    once     Show it once and end.
    as_json  Print one JSON object a second, or one with --once.
    """
    from launch_scripts.commands.status_view import show_top

    show_top(where, each=each, once=once, as_json=as_json)


@command(app, ASK)
def health(url: Annotated[str, typer.Option()], live: bool = False, as_json: shared_options.AsJson = False) -> int:
    """Check if the processes of a machine are ready: exit code 0 if they are, 1 if not, 4 without a reply.

    It needs no router. `swarm status` shows the whole swarm.

    swarm health --url http://127.0.0.1:9464

    swarm health --url http://127.0.0.1:9464 --live

    url   Where metrics or health are served.
    live  Check that processes are alive, not that they are ready.
    """
    from launch_scripts.web.health_probe import ask

    return ask(url, live=live).show(as_json=as_json)


@command(app, ASK)
def metrics(
    where: shared_options.Where,
    port: Annotated[int, typer.Option(min=0, max=shared_options.HIGHEST_PORT)] = 9464,
    signals_address: shared_options.SignalsAddress = "127.0.0.1",
    dashboard: bool = False,
    alerts: bool = False,
) -> None:
    """Serve the metrics of a running swarm to Prometheus, until Ctrl-C.

    swarm metrics --port 9464

    swarm metrics --dashboard > swarm.json

    swarm metrics --alerts > swarm-alerts.yml

    `swarm up --metrics-port 9464` does the same during a run.

    port       Port to listen at; 0 picks one.
    dashboard  Print a dashboard for Grafana, as JSON, and exit.
    alerts     Print rules for alerts of Prometheus, as YAML, and exit.
    """
    if dashboard and alerts:
        raise ConfigError("--dashboard and --alerts print a file each: give one of them")
    if dashboard or alerts:
        name = "dashboard.json" if dashboard else "alerts.yml"
        typer.echo(files("launch_scripts.web").joinpath(name).read_text(encoding="utf-8"), nl=False)
        return
    from launch_scripts.observe.run_observer import OutsideObserver
    from launch_scripts.web.health_pages import Process
    from launch_scripts.web.prometheus import Families, MetricsEndpoint, families
    from swarm.clock import MonotonicClock
    from swarm.runtime.loop_health import Health, supervisor_of
    from swarm.wire.topics import STATS, STATUS

    health = Health(supervisor=supervisor_of(os.environ))
    health.begins(1.0 / _TURN_S)
    endpoint = MetricsEndpoint(port, lambda: [Process("metrics", health.board.read())], signals_address)
    try:
        with where.bus() as bus:
            clock, observer = MonotonicClock(), OutsideObserver(bus, topics={STATS: 0.0, STATUS: 0.0}, follows=True)

            def figures() -> Families:
                run, latest = observer.run, observer.latest
                return families(run, latest, latest.status, latest.up()) if run and latest else Families()

            typer.echo(f"metrics at {endpoint.url}; Ctrl-C ends it")
            printed = None
            while True:
                observer.listen(clock, _TURN_S)
                endpoint.answer(figures)
                health.on_turn([] if observer.run is not None else ["a run"])
                if observer.run is not None and observer.run.run_id != printed:
                    printed = observer.run.run_id
                    typer.echo(f"run {printed}, scenario {observer.run.scenario}")
    except KeyboardInterrupt:
        pass
    finally:
        endpoint.close()
