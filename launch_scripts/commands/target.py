"""`swarm target`: add, move and remove targets while the swarm runs."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from launch_scripts.commands.order_options import checked, give
from launch_scripts.commands.query import Where
from launch_scripts.commands.shared_options import AsJson, Tls, spread

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)
Id = Annotated[str, typer.Argument(metavar="ID", help="The target, such as t3.")]
At = Annotated[str, typer.Option(metavar="ROW,COL", help="Its cell, counted from the north-west corner.")]


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
    walk: Annotated[str, typer.Option(help="still, random, waypoints or evade, as in a scenario.")] = "waypoints",
    speed: Annotated[float, typer.Option(help="Metres per second on level open ground.")] = 4.0,
    as_json: AsJson = False,
) -> None:
    """Add a target. A launcher starts its planner; groups that may chase every target chase it.

    swarm target add x --at 40,200 --walk evade
    """
    _give({"name": id, "new": True, "walk": walk, "speed_m_per_s": speed, **_place(at)}, where, tls, as_json)


@app.command()
@spread
def move(id: Id, at: At, where: Where, tls: Tls, as_json: AsJson = False) -> None:
    """Put a target somewhere else; it goes on from there."""
    _give({"name": id, **_place(at)}, where, tls, as_json)


@app.command()
@spread
def remove(id: Id, where: Where, tls: Tls, as_json: AsJson = False) -> None:
    """Remove a target. Its planner ends, and the vehicles that chased it chase others."""
    _give({"name": id, "off": True}, where, tls, as_json)


def _give(fields: dict[str, Any], where: Where, tls: Tls, as_json: bool) -> None:
    from swarm.wire.messages.orders import GiveOrder

    give([checked(GiveOrder, {"subject": "target", **fields})], where, tls, as_json)


def _place(at: str) -> dict[str, int]:
    from swarm.errors import ConfigError

    try:
        row, col = (int(number) for number in at.split(","))
    except ValueError:
        raise ConfigError(f"--at: {at!r} is no cell, expected row and column such as 40,200") from None
    return {"row": row, "col": col}
