"""Kept grants, by host and by cell, equal those that follow from the grants of all vehicles."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from swarm.config.agents import agent_of
from swarm.wire.messages.traffic import Grant
from vehicle_agent.traffic.grants import Grants

VEHICLES = ["a0-00", "a0-01", "a1-00", "guest-00"]
changes = st.lists(st.tuples(st.sampled_from(VEHICLES), st.lists(st.integers(0, 9), max_size=4, unique=True)))


def check(grants: Grants) -> None:
    by_host: dict[str, dict[str, list[int]]] = {}
    for vehicle, grant in grants.of.items():
        by_host.setdefault(agent_of(vehicle), {})[vehicle] = grant.cells
    assert {host: held for host, held in grants.by_host.items() if held} == by_host
    for cell in range(10):
        holders = {vehicle for vehicle, grant in grants.of.items() if cell in grant.cells}
        assert grants.holders.get(cell) in (holders or {None})
    if len(grants.holders) == sum(len(grant.cells) for grant in grants.of.values()):
        cells = {host: set().union(*held.values()) for host, held in by_host.items()}
        assert {host: held for host, held in grants.cells.items() if held} == cells


@given(changes)
def test_whatever_is_granted_and_freed_hosts_and_holders_follow(granted: list[tuple[str, list[int]]]) -> None:
    grants = Grants({})
    for seq, (vehicle, wanted) in enumerate(granted):
        cells = [cell for cell in wanted if grants.holders.get(cell, vehicle) == vehicle]
        if cells or vehicle in grants.of:
            grants.set(vehicle, cells, (1, seq))
        assert list(grants.cells_of(vehicle)) == cells
        check(grants)


@given(changes, changes)
def test_a_cell_of_a_table_that_grants_it_twice_is_held_until_both_have_left_it(
    made_up: list[tuple[str, list[int]]], freed: list[tuple[str, list[int]]]
) -> None:
    grants = Grants({vehicle: Grant(cells, (1, 0)) for vehicle, cells in made_up if cells})
    check(grants)
    for vehicle, leaves in freed:
        if vehicle in grants.of:
            grants.set(vehicle, [cell for cell in grants.cells_of(vehicle) if cell not in leaves], (1, 1))
            check(grants)
