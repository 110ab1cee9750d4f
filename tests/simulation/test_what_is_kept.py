"""Agents think again only of vehicles about which something changed. No change may be missed: the kept value equals
a recomputed one, in every tick, under faults, in crowds and among obstacles."""

import copy
import dataclasses
import io
from typing import Any

import msgspec
import pytest

from launch_scripts.simulation.faults import random_plan
from launch_scripts.simulation.sample_worlds import SMALL, WIDE, crowd, seeded
from launch_scripts.simulation.simulate import Simulation
from swarm.config.scenario import RoverConfig, agent_of
from swarm.right_of_way.cell_orders import Orders
from swarm.right_of_way.shard_leader import Leader
from swarm.wire.messages.traffic import Entry, Held, Number, Table
from vehicle_agent.driving.driven_vehicle import Vehicle
from vehicle_agent.traffic.next_cells import CellRequests

ROVERS = (
    RoverConfig(name="quick", count=3, speed_m_per_s=3.0, radius_m=4.0),
    RoverConfig(name="still", count=2, speed_m_per_s=0.0, radius_m=8.0),
)
SECONDS = 6.0


def simulation_of(name: str, seed: int, trace: io.StringIO | None = None, slower: float = 1.0) -> Simulation:
    """Agents that make marks all the time, three on one shard or more on many, or four in a crowd; among obstacles,
    or around targets that stay where they were caught."""
    kind, _, others = name.partition(" ")
    of_kind = {"small": SMALL, "wide": WIDE}.get(kind)
    scenario, terrain = (seeded(seed, of_kind), None) if of_kind else crowd(kind, seed, 24, 6, side=13)
    if others == "parked":
        targets = tuple(msgspec.structs.replace(target, caught="stay") for target in scenario.targets)
        scenario = msgspec.structs.replace(scenario, targets=targets)
    rovers = ROVERS if others == "among rovers" else ()
    scenario = msgspec.structs.replace(scenario, rovers=rovers, time_scale=scenario.time_scale / slower)
    faults = random_plan(scenario, seed, SECONDS)
    return Simulation(scenario, faults=faults, terrain=terrain, trace=trace)


WORLDS = pytest.mark.parametrize(
    ("name", "seed"),
    [
        ("small parked", 6),
        ("small among rovers", 1),
        ("doors among rovers", 1),
        ("maze parked", 6),
    ],
)


@WORLDS
def test_events_are_those_of_agents_that_keep_nothing_and_look_at_all_vehicles(name, seed, monkeypatch):
    looked, logs, make = [0, 0], [io.StringIO(), io.StringIO()], CellRequests.make
    run = 0

    def make_requests(requests: CellRequests, vehicles: list[Vehicle], now_ns: int) -> None:
        looked[run] += len(vehicles)
        if run:
            requests.make_anew()
        make(requests, vehicles, now_ns)

    monkeypatch.setattr(CellRequests, "make", make_requests)
    simulation_of(name, seed, logs[0], slower=4.0).run_until(SECONDS)  # several ticks a cell
    monkeypatch.setattr(Vehicle, "needs_nothing", property(lambda vehicle: False))
    run = 1
    simulation_of(name, seed, logs[1], slower=4.0).run_until(SECONDS)
    assert logs[0].getvalue() == logs[1].getvalue()
    assert 80 < looked[0] < looked[1]


def made_anew(leader: Leader) -> Leader:
    """The twin of a leader, which has read its table, and looks at all vehicles of the shard."""
    twin = copy.copy(leader)
    twin._orders = Orders(leader._orders.table(leader._shard, "twin", (0, 0), {}, {}))
    twin._hosts = {
        name: dataclasses.replace(host, asking=list(host.stands.values())) for name, host in leader._hosts.items()
    }
    return twin


def told_anew(leader: Leader, table: Table, host: str) -> tuple[dict[str, Held], dict[str, list[Entry]], list[int]]:
    """The entries that a table lists of a host, and the cells around its vehicles that others hold."""
    every = [*table.grants.items(), *(each for fence in table.fences for each in fence.entries.items())]
    ours = {vehicle: numbers for vehicle, numbers in table.grants.items() if agent_of(vehicle) == host}
    before = [(number, vehicle) for vehicle, numbers in every for number in numbers]
    before.sort(key=lambda each: each[0][1:])

    def entry(number: Number, vehicle: str) -> Entry:
        earlier = [each for each in before if each[0][0] == number[0] and each[0][1:] < number[1:]]
        return Entry(number, [(n[1], n[2], of) for n, of in earlier if of != vehicle])

    state, cols = leader._hosts[host].state, leader._shards.grid.cols
    steps = [south * cols + east for south in (-1, 0, 1) for east in (-1, 0, 1) if south or east]
    near = {stand.end + step for stand in (state.vehicles if state else ()) for step in steps}
    held = {number[0] for _, numbers in every for number in numbers}
    own = {number[0] for numbers in ours.values() for number in numbers}
    each = {vehicle: [entry(number, vehicle) for number in numbers] for vehicle, numbers in ours.items()}
    waits = {vehicle: waits for vehicle, of in each.items() if (waits := [entry for entry in of if entry.after])}
    return ours, waits, sorted(near & (held - own))


@WORLDS
def test_leaders_plan_for_those_who_ask_and_tell_what_a_plan_for_all_would(name, seed, monkeypatch):
    plan, content_of, compared, told = Leader._plan, Leader._content_of, 0, 0

    def plan_twice(leader: Leader, now_ns: int) -> None:
        nonlocal compared
        twin = made_anew(leader)
        plan(twin, now_ns)
        plan(leader, now_ns)
        kept, anew = leader._orders, twin._orders
        assert kept.of == anew.of
        assert {cell: [*order.items()] for cell, order in kept.orders.items()} == {
            cell: [*order.items()] for cell, order in anew.orders.items()
        }
        assert leader._pushed == twin._pushed
        compared += 1

    def content_twice(leader: Leader, table: Table) -> dict[str, Any]:
        nonlocal told
        contents = content_of(leader, table)
        for host, (granted, _) in contents.items():
            assert (granted.grants, granted.waits, granted.occupied) == told_anew(leader, table, host)
            told += 1
        return contents

    monkeypatch.setattr(Leader, "_plan", plan_twice)
    monkeypatch.setattr(Leader, "_content_of", content_twice)
    simulation_of(name, seed).run_until(SECONDS)
    assert compared > 20
    assert told > 50
