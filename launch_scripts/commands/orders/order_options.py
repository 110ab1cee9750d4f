"""What the commands that give orders share."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, TypeVar

import typer

if TYPE_CHECKING:
    from launch_scripts.commands.query import Where
    from launch_scripts.commands.shared_options import Tls
    from swarm.places import Place
    from swarm.runtime.operator import Acknowledged
    from swarm.wire.messages import Message
    from swarm.wire.messages.orders import GiveOrder

M = TypeVar("M", bound="Message")


def checked(kind: type[M], fields: dict[str, Any]) -> M:
    """The order of these fields; those which are None are left out. Raises ConfigError."""
    import msgspec

    from swarm.config.explain import explain
    from swarm.errors import ConfigError
    from swarm.wire.versions import schema_of_type

    given = {name: value for name, value in fields.items() if value is not None}
    try:
        return msgspec.convert({**given, "schema": schema_of_type(kind)}, kind)
    except (msgspec.ValidationError, ValueError) as error:
        said = str(error)
        ours = not said.startswith(("Expected", "Invalid", "Object"))  # what fields say of each other
        said = said.partition(" - at `$")[0] if ours else explain(said, given, kind)
        raise ConfigError(f"the order is not possible: {said}") from None


def give(orders: list[GiveOrder], where: Where, tls: Tls, as_json: bool, at: Place | None = None) -> None:
    """Give orders, one after the other, and print who obeys. Exit code 1 if somebody has not said so.

    at  the place that they are about, if any: becomes their `cell`
    """
    import msgspec

    from launch_scripts.observe.run_observer import frame_of_run
    from swarm.bus.zenoh_bus import open_bus
    from swarm.places import cell_of, fields_of, written
    from swarm.runtime.operator import Operator

    silent = False
    printed: list[dict[str, Any]] = []
    with open_bus(where.network(tls)) as bus:
        operator = Operator(bus)
        frame = None if at is None else frame_of_run(bus, where)
        cell = None if at is None or frame is None else cell_of(at, frame, "--at")
        for order in orders:
            if cell is not None:
                order = msgspec.structs.replace(order, cell=cell)
            given, acknowledged = operator.give(order)
            silent = silent or bool(acknowledged.silent)
            if as_json:
                fields: dict[str, Any] = {"obeyed_s": acknowledged.obeyed, "silent": acknowledged.silent}
                if frame is not None and cell is not None:
                    fields["at"] = fields_of(frame, cell)
                printed.append({"given": msgspec.to_builtins(given), **fields})
            else:
                if frame is not None and cell is not None:
                    typer.echo(f"{order.subject} {order.name} is put at {written(frame, cell)}")
                print_obeyed(acknowledged)
    if as_json:
        typer.echo(json.dumps(printed[0] if len(printed) == 1 else printed, indent=2))
    if silent:
        raise typer.Exit(1)


def print_obeyed(acknowledged: Acknowledged) -> None:
    """Who obeys an order, and who has not said so."""
    took_ms = max(acknowledged.obeyed.values(), default=0.0) * 1e3
    typer.echo(f"{len(acknowledged.obeyed)} processes obey, the last after {took_ms:.0f} ms")
    if acknowledged.silent:
        names = ", ".join(acknowledged.silent)
        typer.echo(f"no answer yet from {names}: they obey as soon as they hear a keeper", err=True)
