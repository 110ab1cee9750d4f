"""`swarm vehicle`: stop single vehicles, and let them go again."""

from __future__ import annotations

from typing import Annotated

import typer

from launch_scripts.command_line import complete
from launch_scripts.commands.orders.order_options import checked, give
from launch_scripts.commands.query import Where
from launch_scripts.commands.shared_options import AsJson, Tls, spread

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)
Ids = Annotated[
    list[str], typer.Argument(metavar="ID...", help="Vehicles, such as a0-03.", autocompletion=complete.vehicle_ids)
]


@app.callback()
def _root() -> None:
    """Let vehicles join a running swarm and leave it; stop vehicles, and let them go again."""


@app.command()
@spread
def stop(ids: Ids, where: Where, tls: Tls, as_json: AsJson = False) -> None:
    """Let vehicles stand in the middle of their cells until they are let go. Others drive around them.

    swarm vehicle stop a0-03 a0-04
    """
    _give(ids, False, where, tls, as_json)


@app.command()
@spread
def go(ids: Ids, where: Where, tls: Tls, as_json: AsJson = False) -> None:
    """Let stopped vehicles go.

    swarm vehicle go a0-03
    """
    _give(ids, True, where, tls, as_json)


def _give(ids: list[str], off: bool, where: Where, tls: Tls, as_json: bool) -> None:
    from swarm.wire.messages.orders import GiveOrder

    orders = [checked(GiveOrder, {"subject": "vehicle", "name": id, "off": off}) for id in ids]
    give(orders, where, tls, as_json)
