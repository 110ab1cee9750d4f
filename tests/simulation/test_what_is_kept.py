"""Agents think again only of vehicles about which something changed. Nothing that changes may be missed: what is
kept is what would be made anew, in every tick, under faults, in crowds and among bodies."""

from __future__ import annotations

import io
from typing import Any

import msgspec
import pytest

from launch_scripts.simulation.faults import random_plan
from launch_scripts.simulation.node import Node
from launch_scripts.simulation.simulate import Simulation
from launch_scripts.simulation.trial import nodes_of
from launch_scripts.simulation.worlds import crowd, seeded
from shared_map.terrain.terrain import Terrain
from swarm.config.scenario import RoverConfig, Scenario
from swarm.right_of_way.holdings import Holdings
from vehicle_agent.driving.vehicle import Vehicle
from vehicle_agent.service import AgentService
from vehicle_agent.traffic.wishes import Wishes

ROVERS = (
    RoverConfig(name="quick", count=3, speed_m_per_s=3.0, radius_m=4.0),
    RoverConfig(name="still", count=2, speed_m_per_s=0.0, radius_m=8.0),
)
SECONDS = 6.0


def world(name: str, seed: int) -> tuple[Scenario, Terrain | None]:
    """Three agents that make marks all the time, or four in a crowd; among bodies, or around targets that stay
    where they were caught."""
    kind, _, others = name.partition(" ")
    scenario, terrain = (seeded(seed), None) if kind == "small" else crowd(kind, seed, 40, 10, side=16)
    if others == "parked":
        targets = tuple(msgspec.structs.replace(target, caught="stay") for target in scenario.targets)
        return msgspec.structs.replace(scenario, targets=targets), terrain
    return msgspec.structs.replace(scenario, rovers=ROVERS if others else ()), terrain


def simulation_of(name: str, seed: int, trace: io.StringIO | None = None) -> Simulation:
    scenario, terrain = world(name, seed)
    faults = random_plan(seed, nodes_of(scenario), SECONDS)
    return Simulation(scenario, faults=faults, terrain=terrain, trace=trace)


@pytest.mark.parametrize(
    ("name", "seed"),
    [("small", 0), ("small parked", 6), ("small among rovers", 1), ("doors among rovers", 1), ("maze parked", 6)],
)
def test_in_every_tick_wishes_and_stands_are_as_if_made_anew(name, seed, monkeypatch):
    compared, kept_wishes = 0, 0
    make = Wishes.make

    def make_twice(wishes: Wishes, vehicles: list[Vehicle], now_ns: int) -> None:
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
            for id in agent.vehicles:
                said = agent.holdings._say(id, agent.holdings.path(id), agent.wishes[id])
                assert said.stands == agent.holdings._said[id].stands

    monkeypatch.setattr(Wishes, "make", make_twice)
    simulation = simulation_of(name, seed)
    simulation.after_tick.append(compare_stands)
    simulation.run_until(SECONDS)
    assert compared > 250
    assert kept_wishes > 100


def keep_nothing(patch: pytest.MonkeyPatch) -> None:
    make, standings = Wishes.make, Holdings.standings

    def make_all(wishes: Wishes, *args: Any) -> None:
        wishes.make_anew()
        make(wishes, *args)

    def say_all(holdings: Holdings, *args: Any) -> Any:
        holdings._said.clear()
        return standings(holdings, *args)

    patch.setattr(Wishes, "make", make_all)
    patch.setattr(Holdings, "standings", say_all)


@pytest.mark.parametrize(("name", "seed"), [("small", 5), ("corridor among rovers", 1)])
def test_a_run_is_the_same_byte_for_byte_if_nothing_is_kept(name, seed, monkeypatch):
    traces = []
    for keeps in (True, False):
        with monkeypatch.context() as patch:
            if not keeps:
                keep_nothing(patch)
            trace = io.StringIO()
            simulation_of(name, seed, trace).run_until(SECONDS)
            traces.append(trace.getvalue())
    assert traces[0].count("\n") > 1000
    assert traces[0] == traces[1]
