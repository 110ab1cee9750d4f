"""`swarm order`: pauses a running swarm, and changes its groups, settings and targets.

Each is one `GiveOrder`, made of a subject and the fields that its command has read (`give`). A keeper stores the
orders in force, and each process acknowledges them.
"""

from __future__ import annotations

import json
import time
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import typer

from launch_scripts.commands.shared_options import AsJson, Where
from launch_scripts.plain_text import number_of, unanswered
from launch_scripts.typer_commands import ORDER, command, family_app
from swarm.config.explain import choice
from swarm.errors import ConfigError

if TYPE_CHECKING:
    from swarm.runtime.operator import Acknowledged

app = family_app("Pause a running swarm, change its settings, zones, targets and vehicles.")
short = typer.Typer()
"""The commands which are also called without their family."""
target_app = family_app("Add, move and remove simulated targets while the swarm runs.")
Key = Annotated[str, typer.Argument(metavar="KEY")]
Id = Annotated[str, typer.Argument(metavar="ID", help="The target, such as t3.")]
At = Annotated[
    str, typer.Option(metavar="PLACE", help="Place: LAT,LON, xy:X,Y in metres of the map, or cell:ROW,COL.")
]


@command(short, ORDER)
@command(app)
def pause(where: Where, as_json: AsJson = False) -> int:
    """Stop all vehicles and simulated targets where they are. Returns once all processes obey.

    Vehicles stop in the middle of the cell that they are entering.

    swarm order pause

    swarm pause
    """
    return give(where, as_json, {"subject": "pause"})


@command(short, ORDER)
@command(app)
def resume(where: Where, as_json: AsJson = False) -> int:
    """Resume all vehicles and targets after a pause.

    swarm order resume

    swarm resume
    """
    return give(where, as_json, {"subject": "pause", "off": True})


@command(app)
def group(
    name: Annotated[str, typer.Argument(metavar="GROUP")],
    where: Where,
    targets: Annotated[list[str], typer.Argument(metavar="TARGET...")],
    as_json: AsJson = False,
) -> int:
    """Set the targets that the vehicles of a group may chase.

    swarm order group red t1 t2

    name     The group.
    targets  The targets that it may chase. `swarm order unset groups.NAME` restores those of the scenario.
    """
    return give(where, as_json, {"subject": "group", "name": name, "targets": targets})


@command(app, name="set", context_settings={"ignore_unknown_options": True})  # a number below 0 is no option
def set_(
    key: Key, where: Where, value: Annotated[float, typer.Argument(metavar="VALUE")], as_json: AsJson = False
) -> int:
    """Change a setting of a running swarm.

    Keys: time_scale, vehicles.reassign_s, planner.cpu_budget, planner.push_s.

    swarm order set time_scale 5

    key    A key of the scenario, such as time_scale.
    value  Its new value. `swarm order unset KEY` restores that of the scenario.
    """
    _check_setting(key)
    return give(where, as_json, {"subject": "set", "name": key, "value": value})


@command(app)
def unset(key: Key, where: Where, as_json: AsJson = False) -> int:
    """Restore a setting, or the targets of a group, from the scenario.

    swarm order unset time_scale

    swarm order unset groups.red

    key  A setting, or groups.NAME for the targets of a group.
    """
    section, _, name = key.partition(".")
    if section == "groups":
        return give(where, as_json, {"subject": "group", "name": name, "off": True})
    _check_setting(key)
    return give(where, as_json, {"subject": "set", "name": key, "off": True})


def _check_setting(key: str) -> None:
    from swarm.runtime.order_book import SETTINGS

    if key not in SETTINGS:
        raise ConfigError(f"{key!r} cannot change while the swarm runs{choice(key, list(SETTINGS))}")


@command(app, name="ls")
def list_orders(where: Where, as_json: AsJson = False) -> None:
    """Print the orders in force. Zones are in `swarm order zone ls`.

    swarm order ls --json
    """
    from swarm.runtime.operator import Operator
    from swarm.runtime.order_book import OrderBook, described

    with where.operators_bus() as (bus, _):
        operator = Operator(bus)
        book, sent = operator.orders(), operator.goals().goals
    if as_json:
        typer.echo(json.dumps([msgspec.to_builtins(order) for order in (*book.orders, *sent)], indent=2))
        return
    known = OrderBook()
    known.merge(book.orders, time.time_ns())
    for ordered in [*known.standing, *(described(goals) for goals in sent if not goals.off)] or ["no orders"]:
        typer.echo(ordered)


@command(target_app)
def add(id: Id, at: At, where: Where, walk: str = "waypoints", speed: float = 4.0, as_json: AsJson = False) -> int:
    """Add a target. A launcher starts its planner; groups that may chase every target chase it.

    swarm order target add x --at 36.50,-84.29 --walk evade

    swarm order target add x --at cell:40,200

    walk   still, random, waypoints or evade, as in a scenario.
    speed  Metres per second on level open ground.
    """
    fields = {"subject": "target", "name": id, "new": True, "walk": walk, "speed_m_per_s": speed}
    return give(where, as_json, fields, at=at)


@command(target_app)
def move(id: Id, at: At, where: Where, as_json: AsJson = False) -> int:
    """Move a target to another cell; it goes on from there.

    swarm order target move t3 --at cell:40,200
    """
    return give(where, as_json, {"subject": "target", "name": id}, at=at)


@command(target_app)
def remove(id: Id, where: Where, as_json: AsJson = False) -> int:
    """Remove a target. Its planner ends, and the vehicles that chased it chase others.

    swarm order target remove t3
    """
    return give(where, as_json, {"subject": "target", "name": id, "off": True})


# --- how an order is given --------------------------------------------------------------------------------------


def give(where: Where, as_json: bool, *orders: dict[str, Any], at: str | None = None) -> int:
    """Gives orders, one after the other, and prints who obeys. Returns 1 if a process has not replied.

    orders  fields of `GiveOrder`, or those with a `vehicle` of `SendVehicle`
    at      the place that they are about, if any: becomes their `cell`
    """
    from launch_scripts.launcher.console import progress
    from launch_scripts.observe.run_observer import frame_of_run
    from swarm.places import cell_of, fields_of, read_place, written
    from swarm.runtime.operator import Operator, checked
    from swarm.wire.messages.orders import GiveOrder, SendVehicle

    # The cell is known once the swarm has said where its terrain lies; all else is checked before it is asked.
    place = None if at is None else read_place(at, "--at")
    made = [
        checked(SendVehicle, fields) if "vehicle" in fields
        else checked(GiveOrder, fields if place is None else {**fields, "cell": 0})
        for fields in orders
    ]  # fmt: skip
    silent = 0
    printed: list[dict[str, Any]] = []
    with where.operators_bus() as (bus, found):
        sent = any(isinstance(order, SendVehicle) and not order.off for order in made)
        if sent and not any(info.plans_to_places for info in found):
            raise ConfigError(where.plans_no_places)
        for order in made:
            place_fields: dict[str, Any] = {}
            if isinstance(order, GiveOrder) and place is not None:
                frame = frame_of_run(bus, where)
                cell = cell_of(place, frame, "--at")
                order = msgspec.structs.replace(order, cell=cell)
                place_fields = {"at": fields_of(frame, cell)}
            with progress("waiting until all processes obey"):
                operator = Operator(bus)
                given, acknowledged = operator.give(order)
            outcome = {"obeyed_s": acknowledged.obeyed, "silent": acknowledged.silent}
            printed.append({"given": msgspec.to_builtins(given), **outcome, **place_fields})
            silent |= bool(acknowledged.silent)
            if not as_json:
                if isinstance(order, GiveOrder) and place is not None:
                    typer.echo(f"{order.subject} {order.name} is put at {written(frame, cell)}")
                print_obeyed(acknowledged)
    if as_json:
        typer.echo(json.dumps(printed[0] if len(printed) == 1 else printed, indent=2))
    return silent


def print_obeyed(acknowledged: Acknowledged) -> int:
    """Prints the processes that obey an order, and those that have not replied. Returns the exit code."""
    from swarm.runtime.operator import OBEY_S

    took_ms = max(acknowledged.obeyed.values(), default=0.0) * 1e3
    typer.echo(f"obeyed by {number_of(len(acknowledged.obeyed), 'process')}, the last after {took_ms:.0f} ms")
    if acknowledged.silent:
        asked = len(acknowledged.silent) + len(acknowledged.obeyed)
        text = unanswered(acknowledged.silent, asked, OBEY_S)
        typer.echo(f"{text}; they obey as soon as they hear a keeper", err=True)
    return int(bool(acknowledged.silent))
