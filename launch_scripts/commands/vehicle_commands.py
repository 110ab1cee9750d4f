"""`swarm order vehicle`: vehicles join a running swarm, leave it, stop, go, and are sent to places."""

from __future__ import annotations

import json
import time
from typing import Annotated

import typer
from msgspec.structs import replace

from launch_scripts.commands.order_commands import give
from launch_scripts.commands.role_commands import Part, run_role
from launch_scripts.commands.shared_options import AsJson, Where
from launch_scripts.typer_commands import command, family_app
from swarm.bus.bus import Bus
from swarm.config.scenario import agent_of
from swarm.errors import BusError, ConfigError
from swarm.grid import GridSpec
from swarm.places import read_place
from swarm.right_of_way.external_on_bus import say_gone
from swarm.runtime.operator import replies_to
from swarm.wire.messages.orders import Then
from swarm.wire.messages.vehicles import Removed, RemoveVehicles
from swarm.wire.topics import LEAVE

_WITHIN_S = 5.0
"""Longest wait until cells are free: leaders answer within a lease, which is shorter."""
_AGAIN_S, _ANSWERS_S = 0.2, 1.0
"""Waits between two questions, and for the answer to one. An agent takes several ticks of 0.1 s to give cells back,
and one that is silent for a second is asked five times within `_WITHIN_S`."""
app = family_app("Send vehicles to places, stop them, let them join a running swarm and leave it.")
Vehicles = Annotated[list[str], typer.Argument(metavar="ID...", help="Vehicles, such as a0-03.")]


@command(app)
def stop(ids: Vehicles, where: Where, as_json: AsJson = False) -> int:
    """Stop vehicles in the middle of their cells until `swarm order vehicle start`. Others drive around them.

    swarm order vehicle stop a0-03 a0-04
    """
    return give(where, as_json, *({"subject": "vehicle", "name": id, "off": False} for id in ids))


@command(app)
def start(ids: Vehicles, where: Where, as_json: AsJson = False) -> int:
    """Start stopped vehicles again.

    swarm order vehicle start a0-03
    """
    return give(where, as_json, *({"subject": "vehicle", "name": id, "off": True} for id in ids))


@command(app, context_settings={"ignore_unknown_options": True})  # a latitude below 0 is no option
def send(
    id: Annotated[str, typer.Argument(metavar="ID")],
    places: Annotated[list[str], typer.Argument(metavar="PLACE...")],
    where: Where,
    then: Then = "hold",
    as_json: AsJson = False,
) -> int:
    """Send a vehicle to one or more places. It chases no target meanwhile.

    The newest order counts. `swarm order ls` and `swarm status` show its progress.

    swarm order vehicle send a0-03 46.81,9.84

    swarm order vehicle send a0-03 cell:40,200 cell:80,20 --then repeat

    id      The vehicle, such as a0-03.
    places  LAT,LON, xy:X,Y in metres of the map, or cell:ROW,COL; up to 64.
    then    After the last: hold there, chase targets again, or repeat from the first.
    """
    for place in places:
        read_place(place, "PLACE")
    return give(where, as_json, {"vehicle": id, "places": places, "then": then})


@command(app)
def recall(ids: Vehicles, where: Where, as_json: AsJson = False) -> int:
    """Recall vehicles that were sent somewhere: they chase targets again.

    swarm order vehicle recall a0-03
    """
    return give(where, as_json, *({"vehicle": id, "off": True} for id in ids))


@command(app)
def add(
    id: Annotated[str, typer.Option()],
    group: Annotated[str, typer.Option()],
    part: Part,
    count: Annotated[int, typer.Option(min=1)] = 1,
    at: Annotated[str | None, typer.Option(metavar="PLACE")] = None,
) -> None:
    """Start an agent with extra vehicles. Runs until they have left, or until Ctrl-C.

    They enter where cells are free, and chase their group's targets. Ctrl-C takes them off the map. If the process
    is killed they stay; the same command finds them again.

    swarm order vehicle add my.toml --id extra --group all --count 5 --at 36.50,-84.29

    id     Name of the agent that hosts them.
    group  The group of the scenario to which they belong.
    count  How many vehicles.
    at     Place near which they enter. Default: anywhere.
    """
    if at is not None:
        read_place(at, "--at")
    run_role("agent", id, part, joins=(group, count, at))


@command(app)
def remove(names: list[str], where: Where, as_json: AsJson = False) -> int:
    """Remove vehicles from the map. Returns once their cells are free for others.

    An added agent ends when its last vehicle has left.

    swarm order vehicle remove extra a0-03

    names  Agents, such as extra, or vehicles, such as a0-03.
    """
    with where.operators_bus() as (bus, found):
        agents = {info.id for info in found if info.role == "agent"}
        asked: dict[str, list[str]] = {}
        for name in names:
            agent = name if name in agents else agent_of(name)
            if agent not in agents:
                there = ", ".join(sorted(agents)) or "none"
                raise ConfigError(f"no agent {agent} takes part {where}; it has {there}")
            asked.setdefault(agent, []).append(name)
        # A request that names the agent itself means all of its vehicles, which an empty list expresses.
        replies = {agent: _remove(bus, agent, [] if agent in some else some) for agent, some in asked.items()}
    for one in replies.values():
        if one.unknown:
            raise ConfigError(f"agent {one.agent} hosts no {', '.join(one.unknown)}")
        if not as_json:
            typer.echo(f"{', '.join(one.left)}: left" + (f"; {one.held} still hold cells" if one.held else ""))
    if as_json:
        typer.echo(json.dumps({agent: {"left": one.left, "held": one.held} for agent, one in replies.items()}))
    return int(any(one.held for one in replies.values()))


@command(app)
def forget(name: str, where: Where) -> None:
    """Release the cells of vehicles of a dead process. Use only if no vehicle is there.

    A robot whose program has died is still in its cell: never use it then. Between machines the command needs the
    external vehicle's own certificate.

    swarm order vehicle forget extra

    name  The dead process: an added agent, such as extra, or an external vehicle, such as rover7.
    """
    with where.operators_bus() as (bus, found):
        run = found[0]
        grid = GridSpec(run.rows, run.cols, run.resolution_m).traffic(run.traffic_parts or 1)
        if not say_gone(bus, name, grid, _WITHIN_S):
            needs = f"this needs the certificate of {name} itself (--tls-dir FOLDER); with it, " * bus.proves_names
            raise BusError(f"the cells of {name} are not known to be free after {_WITHIN_S:g} s: {needs}repeat it")
    typer.echo(f"{name} is removed, and its cells are free")


def _remove(bus: Bus, agent: str, vehicles: list[str]) -> Removed:
    """Asks until the cells of all that left are free, but not for ever."""
    until_s = time.monotonic() + _WITHIN_S
    last: Removed | None = None
    while time.monotonic() < until_s:
        replies, _ = replies_to(bus, LEAVE, RemoveVehicles(vehicles=vehicles), _ANSWERS_S, agent=agent)
        removed = [reply for reply in replies if isinstance(reply, Removed)]
        if last is not None and not removed:
            return replace(last, held=0)  # an added agent ends once leaders know that its last vehicle has left
        if removed:
            last = removed[0]
        if last is not None and not last.held:
            return last
        time.sleep(_AGAIN_S)
    if last is None:
        raise BusError(f"agent {agent} does not answer")
    return last
