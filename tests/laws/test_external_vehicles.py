"""External vehicles in right of way, under the same faults: robots come, crash, come back and leave; agents join
while the swarm runs; operators say that a robot has left. No two vehicles meet, and none is lost. Each rule that
docs/design/external-vehicles.md needs is taken out in turn, and the law must notice.

More histories: `pytest tests/laws/test_external_vehicles.py -m seeds --seeds 0:2000`.
"""

import random
from dataclasses import replace

import pytest
from support import broken_rules as rules
from support.broken_rules import in_place_of
from support.external_world import ExternalWorld
from support.traffic_world import Faults, random_faults

from swarm.config.scenario import agent_of
from swarm.right_of_way.cell_orders import Orders
from swarm.right_of_way.external_vehicle import ExternalVehicle
from swarm.right_of_way.host import Host
from swarm.right_of_way.host_entries import HostEntries
from swarm.right_of_way.shard_leader import SILENT_NS, Leader

QUIET_S = 12.0
SHAPES = (
    (3, 4, 9, 9, 3, 1),
    (4, 3, 10, 5, 3, 1),
    (8, 3, 14, 7, 5, 2),
    (2, 5, 8, 4, 2, 1),
    (5, 4, 12, 4, 4, 1),
    (1, 5, 7, 4, 2, 1),
)
"""(agents, vehicles each, side of the map, side of a shard, robots, added agents)."""


def world_of(seed: int, twins: bool = True) -> ExternalWorld:
    chance = random.Random(f"guests/{seed}")
    shape, faults = chance.choice(SHAPES), random_faults(chance, QUIET_S)
    return ExternalWorld(seed, *shape[:4], faults if twins else replace(faults, twins=0), *shape[4:])


def borders_of(seed: int) -> ExternalWorld:
    """Nine shards of three by three cells, and a network that repeats half of all and delays much for seconds."""
    faults = Faults(repeat=0.5, late=0.3, delay_ms=50, crashes=1, twins=0.3, quiet_s=QUIET_S)
    return ExternalWorld(seed, 4, 3, 9, 3, faults, 5, 1)


def test_external_vehicles_come_and_go_where_nothing_fails() -> None:
    world = ExternalWorld(1, 4, 3, 12, 6, Faults(quiet_s=30), 5, 2)
    world.run(40.0)
    assert world.collisions == []
    assert world.entered > 10
    assert world.left > 3
    assert world.removed > 3


@pytest.mark.seeds(6)
def test_no_two_meet_and_all_move_again_when_it_is_quiet(seed: int) -> None:
    world = world_of(seed, twins=False)
    world.run(QUIET_S + 10.0)
    assert world.unmoved_in(12.0) == []
    assert world.entered


@pytest.mark.seeds(4)
def test_no_two_meet_where_two_robots_have_one_name(seed: int) -> None:
    """The one that is replaced stands still, and others may wait for it for ever."""
    for world in (world_of(seed), borders_of(seed)):
        world.run(QUIET_S + 8.0)
        assert world.collisions == []


@pytest.mark.seeds(4)
def test_cells_of_an_external_vehicle_that_is_gone_are_free_again(seed: int) -> None:
    world = world_of(seed, twins=False)
    world.run(QUIET_S)
    world.end_robots()
    world.run(12.0)
    for process in world.processes:
        for member in process.rights._members.values():
            if member.leader is not None:
                held = [*member.stored.grants, *(each.agent for each in member.stored.fences)]
                assert not set(map(agent_of, held)).intersection(world.robots)


# --- the rules, each taken out ------------------------------------------------------------------------------


def first_cells_are_entered_while_others_are_there(patch: pytest.MonkeyPatch) -> None:
    may = Leader._may_follow
    patch.setattr(Leader, "_may_follow", lambda self, stand, order: not stand.holds or may(self, stand, order))
    patch.setattr(HostEntries, "place", lambda self, vehicle: not self.placed.add(vehicle))


@in_place_of(Leader, "tick")
def a_silent_external_loses_its_cells(tick, self, now_ns):
    for host in self._orders.by_host.keys() - self._fleets.keys():
        heard = self._hosts.get(host)
        if heard is not None and now_ns - heard.spoke_ns > SILENT_NS:
            self._orders.remove(host, {}, (1 << 60, 0))
    return tick(self, now_ns)


@in_place_of(ExternalVehicle, "tick")
def a_robot_that_is_replaced_says_that_it_has_ended(tick, self, now_ns):
    if not self.host.replaced:
        return tick(self, now_ns)
    actions = self.host.host_states({}, now_ns)
    self.host.ended_alone(now_ns)
    return actions


@in_place_of(Host, "hear_granted")
def a_robot_drives_on_though_it_is_replaced(hear, self, granted, now_ns):
    self.generation = self._entries.generation = max(self.generation, granted.generation)
    return hear(self, granted, now_ns)


@in_place_of(Orders, "_open")
def a_cell_that_was_shut_for_a_external_is_anybodys(opened, self, host, each, bodies, holds):
    return opened(self, host, each, {}, {})


@in_place_of(Host, "begin")
def says_of_each_generation_before_that_it_has_ended(begin, self, dead, chance):
    return begin(self, sorted({*dead, self._known_generation} - {0}), chance)


@in_place_of(ExternalWorld, "carry_away")
def an_operator_says_gone_of_one_that_still_stands_there(carry, self, process, back=True):
    bodies = dict(process.disk.bodies)
    carry(self, process, back)
    process.disk.bodies.update(bodies)


RULES: dict[rules.Broken, int] = {
    first_cells_are_entered_while_others_are_there: 0,
    a_silent_external_loses_its_cells: 0,
    a_robot_that_is_replaced_says_that_it_has_ended: 3,
    a_robot_drives_on_though_it_is_replaced: 11,
    a_cell_that_was_shut_for_a_external_is_anybodys: 1,
    rules.forgets_those_before_in_earlier_generations: 72,
    rules.frees_what_the_host_did_not_know_of: 0,
    rules.forgets_where_bodies_are: 3,
    says_of_each_generation_before_that_it_has_ended: 1,
    an_operator_says_gone_of_one_that_still_stands_there: 0,
}
"""A rule -> the history that is tried before the others, because it collided last."""


@pytest.mark.parametrize("broken", RULES, ids=lambda rule: rule.__name__)
def test_each_rule_is_needed(broken: rules.Broken, monkeypatch: pytest.MonkeyPatch) -> None:
    broken(monkeypatch)
    assert rules.collides(RULES[broken], (world_of, borders_of), QUIET_S)
