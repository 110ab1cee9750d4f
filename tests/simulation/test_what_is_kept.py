"""Agents think again only of vehicles about which something changed. No change may be missed: the kept value equals
a recomputed one, in every tick, under faults, in crowds and among obstacles."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Iterator

import msgspec
import pytest

from launch_scripts.simulation.faults import random_plan
from launch_scripts.simulation.node import Node
from launch_scripts.simulation.simulate import Simulation
from launch_scripts.simulation.worlds import SMALL, WIDE, crowd, seeded
from shared_map.terrain.terrain import Terrain
from swarm.config.agents import agent_of
from swarm.config.scenario import RoverConfig, Scenario
from swarm.wire.messages.traffic import Entry, Granted, Number, Table
from vehicle_agent.driving.driven_vehicle import Vehicle
from vehicle_agent.service import AgentService
from vehicle_agent.traffic.cell_orders import Orders
from vehicle_agent.traffic.cell_requests import CellRequests
from vehicle_agent.traffic.shard_leader import Leader

ROVERS = (
    RoverConfig(name="quick", count=3, speed_m_per_s=3.0, radius_m=4.0),
    RoverConfig(name="still", count=2, speed_m_per_s=0.0, radius_m=8.0),
)
SECONDS = 6.0


def world(name: str, seed: int) -> tuple[Scenario, Terrain | None]:
    """Agents that make marks all the time, three on one shard or more on many, or four in a crowd; among obstacles,
    or around targets that stay where they were caught."""
    kind, _, others = name.partition(" ")
    of_kind = {"small": SMALL, "wide": WIDE}.get(kind)
    scenario, terrain = (seeded(seed, of_kind), None) if of_kind else crowd(kind, seed, 40, 10, side=16)
    if others == "parked":
        targets = tuple(msgspec.structs.replace(target, caught="stay") for target in scenario.targets)
        return msgspec.structs.replace(scenario, targets=targets), terrain
    return msgspec.structs.replace(scenario, rovers=ROVERS if others else ()), terrain


def simulation_of(name: str, seed: int) -> Simulation:
    scenario, terrain = world(name, seed)
    faults = random_plan(scenario, seed, SECONDS)
    return Simulation(scenario, faults=faults, terrain=terrain)


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
def test_in_every_tick_wishes_and_stands_are_as_if_made_anew(name, seed, monkeypatch):
    compared = kept_wishes = 0
    make = CellRequests.make

    def make_twice(wishes: CellRequests, vehicles: list[Vehicle], now_ns: int) -> None:
        nonlocal compared, kept_wishes
        before = dict(wishes._made_of)
        make(wishes, vehicles, now_ns)
        kept = dict(wishes.of)
        kept_wishes += sum(before.get(id) is made_of for id, made_of in wishes._made_of.items())
        wishes.make_anew()
        make(wishes, vehicles, now_ns)
        assert wishes.of == kept
        compared += len(vehicles)

    def compare_stands(node: Node) -> None:
        if isinstance(node.service, AgentService):
            agent = node.service.agent
            by_shard: dict[int, list[object]] = {}
            for id in agent.vehicles:
                said = agent.holdings._say(id, agent.holdings._paths[id], agent.wishes[id])
                for shard, told in said.stands.items():
                    by_shard.setdefault(shard, []).append((id, told))
            kept = {shard: [*stands.items()] for shard, stands in agent.holdings._stands.items() if stands}
            assert kept == by_shard

    monkeypatch.setattr(CellRequests, "make", make_twice)
    simulation = simulation_of(name, seed)
    simulation.after_tick.append(compare_stands)
    simulation.run_until(SECONDS)
    assert compared > 250
    assert kept_wishes > 100


def made_anew(leader: Leader) -> Leader:
    """The twin of a leader, which has read its table, and looks at all vehicles of the shard."""
    twin = copy.copy(leader)
    twin._orders = Orders(leader._orders.table(leader._shard, "twin", (0, 0), {}))
    twin._hosts = {
        name: dataclasses.replace(host, asking=list(host.stands.values())) for name, host in leader._hosts.items()
    }
    return twin


def told_anew(leader: Leader, table: Table, host: str) -> tuple[dict[str, list[Entry]], list[int]]:
    """The entries that a table lists of a host, and the cells around its vehicles that others hold."""
    every = [*table.grants.items(), *(each for fence in table.fences for each in fence.entries.items())]
    ours = {vehicle: numbers for vehicle, numbers in table.grants.items() if agent_of(vehicle) == host}
    before = [(number, vehicle) for vehicle, numbers in every for number in numbers]
    before.sort(key=lambda each: each[0][1:])

    def entry(number: Number, vehicle: str) -> Entry:
        earlier = [each for each in before if each[0][0] == number[0] and each[0][1:] < number[1:]]
        return Entry(number, [(n[1], n[2], of) for n, of in earlier if of != vehicle])

    standing, cols = leader._hosts[host].standing, leader._shards.grid.cols
    steps = [south * cols + east for south in (-1, 0, 1) for east in (-1, 0, 1) if south or east]
    near = {stand.end + step for stand in (standing.vehicles if standing else ()) for step in steps}
    held = {number[0] for _, numbers in every for number in numbers}
    own = {number[0] for numbers in ours.values() for number in numbers}
    grants = {vehicle: [entry(number, vehicle) for number in numbers] for vehicle, numbers in ours.items()}
    return grants, sorted(near & (held - own))


@WORLDS
def test_leaders_plan_for_those_who_ask_and_tell_what_a_plan_for_all_would(name, seed, monkeypatch):
    plan, granted, compared, told = Leader._plan, Leader.granted, 0, 0

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

    def granted_twice(leader: Leader, table: Table, now_ns: int) -> Iterator[Granted]:
        nonlocal told
        for said in granted(leader, table, now_ns):
            assert (said.grants, said.occupied) == told_anew(leader, table, said.host)
            told += 1
            yield said

    monkeypatch.setattr(Leader, "_plan", plan_twice)
    monkeypatch.setattr(Leader, "granted", granted_twice)
    simulation_of(name, seed).run_until(SECONDS)
    assert compared > 20
    assert told > 50
