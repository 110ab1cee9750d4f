"""Sub-commands that ask a running swarm."""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from launch_scripts.commands.shared_options import AsJson, PresetOption, Tls, spread
from swarm.places import extent_of, fields_of, written

if TYPE_CHECKING:
    from launch_scripts.report.results.certified_gap import CertifiedGap
    from shared_map.terrain.places import MapFrame
    from swarm.config.scenario import NetworkConfig
    from swarm.wire.messages.planning import PlannerStatus
    from swarm.wire.messages.processes import RunInfo, Stats

app = typer.Typer()

_PANEL = "Ask a running swarm"
_CONNECT_S = 3.0
_STATUS_LISTEN_S = 1.5


@dataclass(frozen=True)
class Where:
    """Router and namespace of the swarm that a command asks."""

    connect: Annotated[str, typer.Option(help="The router's endpoint.")] = "tcp/127.0.0.1:7447"
    namespace: Annotated[str, typer.Option(help="Prefix of all keys.")] = "swarm"

    def network(self, tls: Tls) -> NetworkConfig:
        import msgspec

        from launch_scripts.launcher.options import as_process, with_network
        from launch_scripts.process_table import LAUNCHER
        from swarm.config.scenario import Scenario

        chosen = with_network(Scenario(), connect=self.connect, namespace=self.namespace, tls=tls.config())
        network = as_process(chosen, LAUNCHER, "0").network
        return msgspec.structs.replace(network, connect_timeout_s=_CONNECT_S)

    def __str__(self) -> str:
        return f"in namespace {self.namespace!r} at {self.connect}"


@app.command(rich_help_panel=_PANEL)
@spread
def route(
    where: Where,
    tls: Tls,
    target: Annotated[str | None, typer.Option(help="The target, such as t3.")] = None,
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
    out: Annotated[
        Path | None, typer.Option(help="Write .geojson, .gpx, .kml or .csv; with --terrain also .png, a picture.")
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

    answer = swarm_route.ask_planner(where.network(tls), where, target, place, cost=cost, steps=steps)
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
    from swarm.places import written

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


@app.command(rich_help_panel=_PANEL)
@spread
def status(where: Where, tls: Tls, as_json: AsJson = False) -> None:
    """Show who takes part in the running swarm and how the planners are doing."""
    from launch_scripts.commands.run_frame import frame_of_members
    from launch_scripts.launcher.watcher import ask_run
    from launch_scripts.report.results.certified_gap import certified_gap, gaps_to
    from launch_scripts.report.results.counts import Counts
    from swarm.bus.bus import Heard
    from swarm.bus.zenoh_bus import open_bus
    from swarm.errors import BusError
    from swarm.order_book import OrderBook
    from swarm.runtime.inbox import Inbox
    from swarm.wire.messages.orders import Orders
    from swarm.wire.messages.planning import PlannerStatus
    from swarm.wire.messages.processes import Beat, Stats
    from swarm.wire.topics import LEAD, ORDERS, STATS, STATUS

    inbox = Inbox()
    book = OrderBook()
    counts = Counts()
    stats: dict[tuple[str, str], Stats] = {}
    planners: dict[str, PlannerStatus] = {}
    leads: dict[tuple[str, str], bool] = {}
    with open_bus(where.network(tls)) as bus:
        bus.subscribe(STATS, inbox.post)
        bus.subscribe(STATUS, inbox.post)
        bus.subscribe(LEAD, inbox.post)
        bus.subscribe(ORDERS, inbox.post, role="keeper")
        until_s = time.monotonic() + _STATUS_LISTEN_S
        found = ask_run(bus, routers=True)
        while (left_s := until_s - time.monotonic()) > 0:
            match inbox.take(left_s):
                case Heard(message=Stats() as message):
                    stats[message.role, message.id] = message
                    counts.count(message)
                case Heard(message=PlannerStatus() as message):
                    planners[message.target] = message
                case Heard(message=Beat() as message):
                    leads[message.role, message.id] = message.leads
                case Heard(message=Orders() as message):
                    book.merge(message.orders, time.time_ns())
    if not found:
        admitted = "" if tls.tls_ca is None else ", and does the router admit this certificate"
        raise BusError(f"nobody answers {where}: is the swarm running{admitted}?")
    # The run is that of most; routers belong to none; whoever answers with another is a stranger.
    runs = Counter((info.run_id, info.terrain) for info in found if info.run_id)
    run = runs.most_common(1)[0][0] if runs else ("", "")
    found.sort(key=lambda info: (not info.run_id, info.role, info.id))
    strangers = [info for info in found if info.run_id and (info.run_id, info.terrain) != run]
    members = [info for info in found if info not in strangers]
    frame = frame_of_members(members)
    if as_json:
        fields = _status_fields(members, stats, planners, leads, frame)
        fields["certified_gap"] = certified_gap(counts).fields()
        fields["certified_gap_to"] = {id: gap.fields() for id, gap in gaps_to(counts).items()}
        fields["orders"] = book.standing
        fields["strangers"] = [f"{info.role}-{info.id}" for info in strangers]
        typer.echo(json.dumps(fields, indent=2))
    else:
        _print_status(members, stats, planners, leads, frame, gaps_to(counts))
        typer.echo(f"certified gap of the routes begun (above: mean per target): {certified_gap(counts)}")
        for ordered in book.standing:
            typer.secho(f"ordered: {ordered}", fg="yellow")
        for info in strangers:
            typer.secho(
                f"stranger {info.role}-{info.id} answers for run {info.run_id[:40]}, terrain {info.terrain[:40]}",
                fg="yellow",
            )


def _status_fields(
    members: list[RunInfo],
    stats: dict[tuple[str, str], Stats],
    planners: dict[str, PlannerStatus],
    leads: dict[tuple[str, str], bool],
    frame: MapFrame | None,
) -> dict[str, Any]:
    import msgspec

    def planner_fields(planner: PlannerStatus) -> dict[str, Any]:
        cell = _target_cell(planner, frame)
        return {
            **msgspec.to_builtins(planner),
            "target_at": None if frame is None or cell is None else fields_of(frame, cell),
        }

    return {
        "run_id": members[0].run_id,
        "scenario": members[0].scenario,
        "terrain": members[0].terrain,
        "processes": [
            {
                "role": info.role,
                "id": info.id,
                "incarnation": info.incarnation,
                "leads": leads.get((info.role, info.id)),
                "counts": stats[info.role, info.id].counts if (info.role, info.id) in stats else None,
                "gauges": stats[info.role, info.id].gauges if (info.role, info.id) in stats else None,
            }
            for info in members
        ],
        "crs": None if frame is None else frame.grid.crs,
        "planners": [planner_fields(planners[target]) for target in sorted(planners)],
    }


def _target_cell(planner: PlannerStatus, frame: MapFrame | None) -> int | None:
    """Where the planner's target is; None if that is not known, or not on this terrain."""
    cell = planner.target_cell
    return cell if frame is not None and cell is not None and 0 <= cell < frame.grid.cells else None


def _throttled(stats: dict[tuple[str, str], Stats]) -> list[str]:
    """Authors which a keeper throttles."""
    from shared_map.keeper.service import THROTTLED

    gauges = {name for each in stats.values() for name in each.gauges}
    return sorted(name.removeprefix(THROTTLED) for name in gauges if name.startswith(THROTTLED))


def _print_status(
    members: list[RunInfo],
    stats: dict[tuple[str, str], Stats],
    planners: dict[str, PlannerStatus],
    leads: dict[tuple[str, str], bool],
    frame: MapFrame | None,
    gaps: Mapping[str, CertifiedGap],
) -> None:
    from rich.console import Console
    from rich.table import Table

    from launch_scripts.report.results.certified_gap import percent

    first = members[0]
    console = Console()
    if first.run_id:
        run = f"run {first.run_id}, scenario {first.scenario}, {first.rows} x {first.cols} cells"
    else:
        run = "no run yet: only routers answer"
    console.print(run, highlight=False)
    if frame is not None and frame.grid.crs != "local":
        console.print(f"terrain: {extent_of(frame, 'latlon')}", highlight=False)
    now_ns = time.time_ns()
    crew = Table("process", "up s", "messages out", "in", "dropped", pad_edge=False)
    for info in members:
        counts = stats[info.role, info.id].counts if (info.role, info.id) in stats else {}
        numbers = (counts.get(name) for name in ("messages_out", "messages_in", "payloads_dropped"))
        up_s = (now_ns - info.incarnation) / 1e9
        leading = {True: ", leads", False: ", stands by", None: ""}[leads.get((info.role, info.id))]
        told = ("-" if n is None else str(n) for n in numbers)
        crew.add_row(f"{info.role}-{info.id}{leading}", f"{up_s:.0f}", *told)
    console.print(crew)
    for author in _throttled(stats):
        console.print(f"author {author} exceeds its quota; its marks are delayed", style="yellow")
    if planners:
        trees = Table(
            *("target", "following", "strategy", "tree ms", "growths", "windows", "served", "gap"),
            *("pose s", "tracker"),
            pad_edge=False,
        )
        for id, planner in sorted(planners.items()):
            gap = percent(gaps[id].mean) if id in gaps else "-"
            trees.add_row(
                id,
                str(planner.following),
                planner.strategy,
                f"{planner.growth_ms:.1f}",
                str(planner.growths),
                str(planner.window_growths),
                str(planner.routes_served),
                gap,
                "-" if planner.pose_age_s is None else f"{planner.pose_age_s:.1f}",
                "lost" if planner.tracker_lost else planner.tracker or "-",
                style="yellow" if planner.tracker_lost else None,
            )
        console.print(trees)
        for id, planner in sorted(planners.items()):
            cell = _target_cell(planner, frame)
            if frame is not None and cell is not None:
                was = "was" if planner.tracker_lost else "is"
                console.print(f"{id} {was} at {written(frame, cell)}", highlight=False, soft_wrap=True)


@app.command(rich_help_panel=_PANEL)
@spread
def metrics(
    where: Where,
    tls: Tls,
    port: Annotated[int, typer.Option(min=0, max=65535, help="On loopback; 0 picks one.")] = 9464,
    dashboard: Annotated[
        bool, typer.Option("--dashboard", help="Print a dashboard for Grafana, as JSON, and exit.")
    ] = False,
) -> None:
    """Serve the figures of a running swarm to Prometheus, until Ctrl-C. It only listens.

    swarm metrics --port 9464

    swarm metrics --dashboard > swarm.json

    `swarm up --metrics-port 9464` does the same for as long as the run lasts.
    """
    from launch_scripts.commands import metrics as command

    if dashboard:
        typer.echo(command.dashboard())
    else:
        command.serve_metrics(where.network(tls), port)
