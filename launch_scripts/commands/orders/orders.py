"""Sub-commands that give a running swarm orders."""

from __future__ import annotations

import json
import time
from typing import Annotated

import typer

from launch_scripts.command_line import complete, panels
from launch_scripts.commands.orders.order_options import checked, give
from launch_scripts.commands.query import Where
from launch_scripts.commands.shared_options import AsJson, Tls, spread

app = typer.Typer()


@app.command(rich_help_panel=panels.ORDER)
@spread
def pause(where: Where, tls: Tls, as_json: AsJson = False) -> None:
    """Stop all vehicles and simulated targets where they are. Returns once all processes obey.

    Vehicles drive to the middle of the cell that they are entering and stand there. Planners go on planning.

    swarm pause
    """
    from swarm.wire.messages.orders import GiveOrder

    give([GiveOrder(subject="pause")], where, tls, as_json)


@app.command(rich_help_panel=panels.ORDER)
@spread
def resume(where: Where, tls: Tls, as_json: AsJson = False) -> None:
    """Let all go on after a pause.

    swarm resume
    """
    from swarm.wire.messages.orders import GiveOrder

    give([GiveOrder(subject="pause", off=True)], where, tls, as_json)


@app.command(rich_help_panel=panels.ORDER)
@spread
def group(
    name: Annotated[str, typer.Argument(metavar="GROUP", help="The group.", autocompletion=complete.group_names)],
    where: Where,
    tls: Tls,
    targets: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[targets] TARGET...",
            help="The targets that it may chase.",
            autocompletion=complete.target_ids,
        ),
    ] = None,
    as_scenario: Annotated[bool, typer.Option("--as-scenario", help="Those that the scenario says.")] = False,
    as_json: AsJson = False,
) -> None:
    """Say which targets the vehicles of a group may chase.

    swarm group red targets t1 t2

    swarm group red --as-scenario
    """
    from swarm.errors import ConfigError
    from swarm.wire.messages.orders import GiveOrder

    chosen = list(targets or ())
    if chosen[:1] == ["targets"]:
        chosen = chosen[1:]
    if as_scenario == bool(chosen):
        raise ConfigError("group: give either targets or --as-scenario")
    fields = {"subject": "group", "name": name, "targets": chosen, "off": as_scenario}
    give([checked(GiveOrder, fields)], where, tls, as_json)


@app.command(name="set", rich_help_panel=panels.ORDER)
@spread
def set_(
    key: Annotated[
        str,
        typer.Argument(
            metavar="KEY",
            help="A key of the scenario, such as time_scale.",
            autocompletion=complete.words("swarm.runtime.order_book", "SETTINGS"),
        ),
    ],
    where: Where,
    tls: Tls,
    value: Annotated[float | None, typer.Argument(metavar="VALUE", help="Its new value.")] = None,
    as_scenario: Annotated[bool, typer.Option("--as-scenario", help="The value that the scenario says.")] = False,
    as_json: AsJson = False,
) -> None:
    """Change a setting while the swarm runs: time_scale, vehicles.reassign_s, planner.cpu_budget, planner.push_s.

    swarm set time_scale 5

    swarm set time_scale --as-scenario
    """
    from swarm.config.explain import choice
    from swarm.errors import ConfigError
    from swarm.runtime.order_book import SETTINGS
    from swarm.wire.messages.orders import GiveOrder

    if as_scenario == (value is not None):
        raise ConfigError("set: give either a value or --as-scenario")
    if key not in SETTINGS:
        raise ConfigError(f"set: {key!r} cannot change while the swarm runs{choice(key, list(SETTINGS))}")
    fields = {"subject": "set", "name": key, "value": value, "off": as_scenario}
    give([checked(GiveOrder, fields)], where, tls, as_json)


@app.command(rich_help_panel=panels.ORDER)
@spread
def orders(where: Where, tls: Tls, as_json: AsJson = False) -> None:
    """Print what is ordered and not taken back. Zones are in `swarm zone list`.

    swarm orders --json
    """
    import msgspec

    from swarm.bus.zenoh_bus import open_bus
    from swarm.runtime.operator import Operator
    from swarm.runtime.order_book import OrderBook

    with open_bus(where.network(tls)) as bus:
        book = Operator(bus).orders()
    if as_json:
        typer.echo(json.dumps([msgspec.to_builtins(order) for order in book.orders], indent=2))
        return
    known = OrderBook()
    known.merge(book.orders, time.time_ns())
    for ordered in known.standing or ["no orders"]:
        typer.echo(ordered)
