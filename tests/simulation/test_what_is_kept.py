"""Agents think again only of vehicles about which something changed. No change may be missed: the kept value equals
a recomputed one, in every tick, under faults, in crowds and among bodies."""

from __future__ import annotations

import copy
from collections.abc import Iterator

import msgspec
import pytest
from vehicle_agent.traffic.grants import Grants

from launch_scripts.simulation.faults import random_plan
from launch_scripts.simulation.node import Node
from launch_scripts.simulation.simulate import Simulation
from launch_scripts.simulation.worlds import SMALL, WIDE, crowd, seeded
from shared_map.terrain.terrain import Terrain
from swarm.config.agents import agent_of
from swarm.config.scenario import RoverConfig, Scenario
from swarm.wire.messages.traffic import Granted, Table
from vehicle_agent.driving.driven_vehicle import Vehicle
from vehicle_agent.service import AgentService
from vehicle_agent.traffic.cell_requests import CellRequests
from vehicle_agent.traffic.pibt import Mover, Round
from vehicle_agent.traffic.warden import SILENT_NS, Warden, _is_entering, _turn

ROVERS = (
    RoverConfig(name="quick", count=3, speed_m_per_s=3.0, radius_m=4.0),
    RoverConfig(name="still", count=2, speed_m_per_s=0.0, radius_m=8.0),
)
SECONDS = 6.0


def world(name: str, seed: int) -> tuple[Scenario, Terrain | None]:
    """Agents that make marks all the time, three on one plot or more on many, or four in a crowd; among bodies, or
    around targets that stay where they were caught."""
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
            by_plot: dict[int, list[object]] = {}
            for id in agent.vehicles:
                said = agent.holdings._say(id, agent.holdings._paths[id], agent.wishes[id])
                for plot, told in said.stands.items():
                    by_plot.setdefault(plot, []).append((id, told))
            kept = {plot: [*stands.items()] for plot, stands in agent.holdings._stands.items() if stands}
            assert kept == by_plot

    monkeypatch.setattr(CellRequests, "make", make_twice)
    simulation = simulation_of(name, seed)
    simulation.after_tick.append(compare_stands)
    simulation.run_until(SECONDS)
    assert compared > 250
    assert kept_wishes > 100


def plan_all(warden: Warden, now_ns: int) -> None:
    """The twin of a warden's plan: it looks at all vehicles of the plot and all their cells."""
    hosts = [each for each in warden._hosts.values() if each.standing and now_ns - each.heard_ns <= SILENT_NS]
    stands = sorted((stand for host in hosts for stand in host.stands.values()), key=_turn)
    shut = {cell for cells in warden._shut.values() for cell in cells}
    held = shut.union(*(grant.cells for grant in warden._grants.of.values()))
    closed = set(held)
    movers: dict[str, Mover] = {}
    for stand in stands:
        cells = warden._grants.cells_of(stand.vehicle)
        if not cells and _is_entering(stand):
            continue
        if stand.cell != stand.end or (cells and cells != [stand.cell]):
            closed.difference_update(cells[:-1] if stand.end in cells else cells)
            continue
        closed.difference_update(cells)
        movers[stand.vehicle] = Mover(
            stand.vehicle, stand.cell, stand.wants, stand.better, stand.age_ms, outside=not cells
        )
    closed |= shut
    plots, plot = warden._plots, warden._plot
    round = Round([*movers.values()], closed.__contains__, lambda cell: plots.of(cell) == plot)
    for stand in stands:
        if stand.vehicle in movers:
            round.plan(movers[stand.vehicle])
        elif stand.ahead:
            warden._grant(stand, warden._next_ahead(stand), held, round.taken)
    for stand in stands:
        to = round.to.get(stand.vehicle)
        if to is not None and to != stand.cell:
            ahead = stand.ahead if stand.ahead[:1] == [to] else [to]
            warden._grant(stand, ahead, held, round.taken)
    warden._pushed = round.pushed


def told_anew(warden: Warden, table: Table, host: str) -> tuple[dict[str, list[int]], list[int]]:
    """The cells that a table grants to a host, and the cells around its vehicles that others hold."""
    grants = {vehicle: grant.cells for vehicle, grant in table.grants.items() if agent_of(vehicle) == host}
    standing, cols = warden._hosts[host].standing, warden._plots.grid.cols
    steps = [south * cols + east for south in (-1, 0, 1) for east in (-1, 0, 1) if south or east]
    near = {stand.end + step for stand in (standing.vehicles if standing else ()) for step in steps}
    held = {cell for id, grant in table.grants.items() if id not in grants for cell in grant.cells}
    return grants, sorted(near & (held | {cell for shut in table.shut for cell in shut.cells}))


@WORLDS
def test_wardens_plan_for_those_who_ask_and_tell_what_a_plan_for_all_would(name, seed, monkeypatch):
    plan, granted, compared, told = Warden._plan, Warden.granted, 0, 0

    def plan_twice(warden: Warden, now_ns: int) -> None:
        nonlocal compared
        twin = copy.copy(warden)
        twin._grants = Grants(warden._grants.of)
        plan_all(twin, now_ns)
        plan(warden, now_ns)
        assert warden._grants.of == twin._grants.of
        assert warden._pushed == twin._pushed
        compared += 1

    def granted_twice(warden: Warden, table: Table, now_ns: int) -> Iterator[Granted]:
        nonlocal told
        for said in granted(warden, table, now_ns):
            assert (said.grants, said.occupied) == told_anew(warden, table, said.host)
            told += 1
            yield said

    monkeypatch.setattr(Warden, "_plan", plan_twice)
    monkeypatch.setattr(Warden, "granted", granted_twice)
    simulation_of(name, seed).run_until(SECONDS)
    assert compared > 20
    assert told > 50
