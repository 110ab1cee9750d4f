"""`swarm target`: add, move and remove targets while the swarm runs."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from launch_scripts.command_line import complete
from launch_scripts.commands.orders.order_options import checked, give
from launch_scripts.commands.query import Where
from launch_scripts.commands.shared_options import AsJson, Tls, spread

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)
Id = Annotated[
    str, typer.Argument(metavar="ID", help="The target, such as t3.", autocompletion=complete.target_ids)
]
At = Annotated[
    str, typer.Option(metavar="PLACE", help="Where it is: LAT,LON, xy:X,Y in metres of the map, or cell:ROW,COL.")
]


@app.callback()
def _root() -> None:
    """Add, move and remove simulated targets while the swarm runs."""


@app.command()
@spread
def add(
    id: Id,
    at: At,
    where: Where,
    tls: Tls,
    walk: Annotated[
        str,
        typer.Option(
            help="still, random, waypoints or evade, as in a scenario.",
            autocompletion=complete.words("swarm.config.values", "Walk"),
        ),
    ] = "waypoints",
    speed: Annotated[float, typer.Option(help="Metres per second on level open ground.")] = 4.0,
    as_json: AsJson = False,
) -> None:
    """Add a target. A launcher starts its planner; groups that may chase every target chase it.

    swarm target add x --at 36.41,-84.29 --walk evade

    swarm target add x --at cell:40,200
    """
    _give({"name": id, "new": True, "walk": walk, "speed_m_per_s": speed}, where, tls, as_json, at)


@app.command()
@spread
def move(id: Id, at: At, where: Where, tls: Tls, as_json: AsJson = False) -> None:
    """Put a target somewhere else; it goes on from there.

    swarm target move t3 --at cell:40,200
    """
    _give({"name": id}, where, tls, as_json, at)


@app.command()
@spread
def remove(id: Id, where: Where, tls: Tls, as_json: AsJson = False) -> None:
    """Remove a target. Its planner ends, and the vehicles that chased it chase others.

    swarm target remove t3
    """
    _give({"name": id, "off": True}, where, tls, as_json)


def _give(fields: dict[str, Any], where: Where, tls: Tls, as_json: bool, at: str | None = None) -> None:
    from swarm.places import read_place
    from swarm.wire.messages.orders import GiveOrder

    place = None if at is None else read_place(at, "--at")
    # The cell is known once the swarm has said where its terrain lies; all else is checked before it is asked.
    cell = {} if place is None else {"cell": 0}
    give([checked(GiveOrder, {"subject": "target", **fields, **cell})], where, tls, as_json, at=place)
