"""The keeper's book of orders: what it acknowledges is on its disk, and every keeper comes to hold it."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from support.bus_world import answer_of
from support.swarm_model import SwarmModel

from shared_map.keeper.mark_store import KeeperStore
from shared_map.terrain.terrain import terrain_of_pace
from swarm.bus.bus import Event
from swarm.config.scenario_files import parse_scenario
from swarm.grid import GridSpec
from swarm.peers import Peer
from swarm.wire.codec import decode, encode
from swarm.wire.messages.orders import GiveOrder, Goals, GoalState, GoalStates, Order, Orders, SendVehicle
from swarm.wire.topics import GIVE_ORDER, GOAL_STATES, GOALS, SEND_VEHICLE

SCENARIO = "[[targets]]\ncount = 2\n[[groups]]\nvehicles = 2"
PACE = np.ones((20, 30), np.float32)
PACE[3, 4] = np.inf


class BookWorld(SwarmModel):
    """Keepers, and a person who gives orders."""

    def __init__(self, grid: GridSpec | None = None, scenario: str = SCENARIO) -> None:
        terrain = terrain_of_pace(PACE)
        terrain = terrain if grid is None else dataclasses.replace(terrain, grid=grid)
        super().__init__(terrain=terrain, scenario=parse_scenario(scenario))
        self.person = self.bus("person")

    def give(self, keeper: str = "k", **fields: Any) -> list[Order] | str | None:
        """The book of the keeper after that, or its refusal."""
        order = GiveOrder(**fields, stamp_ns=self.now_ns)
        answer: Orders | str | None = answer_of(self, self.person, GIVE_ORDER, order, keeper=keeper)
        self.run(0.2)
        return answer.orders if isinstance(answer, Orders) else answer


@pytest.fixture
def world() -> BookWorld:
    return BookWorld()


def test_an_acknowledged_order_is_on_the_disk(tmp_path: Path, world: BookWorld) -> None:
    with KeeperStore(tmp_path / "map.sqlite") as store:
        world.keeper("k", store)
        assert isinstance(world.give(subject="pause"), list)
        world.kill("k.1")
    with KeeperStore(tmp_path / "map.sqlite") as store:
        world.keeper("k", store, 2)
        (order,) = world.give() or ()
        assert (order.subject, order.off) == ("pause", False)


def test_a_keeper_with_a_new_store_learns_what_is_ordered_and_keepers_agree(world: BookWorld) -> None:
    stores = [KeeperStore(":memory:"), KeeperStore(":memory:")]
    world.keeper("k", stores[0])
    world.give(subject="vehicle", name="a0-01")
    world.keeper("l", stores[1])
    world.give("l", subject="pause")
    world.run(2.5)
    assert world.give("k") == world.give("l")
    assert stores[0].orders() == stores[1].orders() == world.give("k")
    world.give("k", subject="pause", off=True)
    world.run(1.5)
    assert world.give("k") == world.give("l") == stores[1].orders()


def test_a_store_that_cannot_be_written_acknowledges_nothing(world: BookWorld) -> None:
    store = KeeperStore(":memory:")
    world.keeper("k", store)
    store._db.execute("PRAGMA query_only = 1")
    refusal = world.give(subject="pause")
    assert "cannot write the store" in refusal
    assert world.give() == []
    store._db.execute("PRAGMA query_only = 0")
    assert isinstance(world.give(subject="pause"), list)


def test_a_target_is_put_on_passable_ground_of_the_terrain_only(world: BookWorld) -> None:
    world.keeper("k", KeeperStore(":memory:"))
    assert world.give(subject="target", name="x", row=3, col=4, new=True) == "target x: [3, 4] is lethal"
    outside = world.give(subject="target", name="x", row=400, col=4, new=True)
    assert outside == "target x: at is 'cell:400,4', outside the terrain: 20 x 30 cells"
    assert "'cell:-1,4'" in world.give(subject="target", name="x", row=-1, col=4, new=True)
    assert isinstance(world.give(subject="target", name="x", row=3, col=5, new=True), list)


def test_vehicles_of_agents_that_joined_later_are_stopped_too(world: BookWorld) -> None:
    world.keeper("k", KeeperStore(":memory:"))
    assert isinstance(world.give(subject="vehicle", name="guest-03"), str)
    world.bus("guest").declare_alive(Peer("agent", "guest", 7))
    world.run(0.2)
    assert isinstance(world.give(subject="vehicle", name="guest-03"), list)
    assert isinstance(world.give(subject="vehicle", name="a0-77"), str)


PLACED = GridSpec(20, 30, 10.0, 500_000.0, 5_200_000.0, "EPSG:32632")


@pytest.mark.parametrize("place", ["46.9532,9.0007", "xy:500053.5,5199967.0", "cell:3,5", "3,5"])
def test_a_target_is_put_at_a_place(place: str) -> None:
    world = BookWorld(PLACED)
    world.keeper("k", KeeperStore(":memory:"))
    order = decode(encode(GiveOrder(subject="target", name="x", at=place, new=True)), GiveOrder)
    (given,) = world.give(subject=order.subject, name=order.name, at=order.at, new=order.new) or ()
    assert given.cell == 95
    refusal = world.give(subject="target", name="y", at="47.5,9.0", new=True)
    assert "target y: at is '47.5,9.0', outside the terrain: latitude 46.9" in str(refusal)
    for wrong in ({"at": "there"}, {"at": "1,1", "cell": 3}, {}):
        with pytest.raises(ValueError, match=r"at is 'there'|give either cell|or at"):
            GiveOrder(subject="target", name="x", **wrong).relate()


# --- goals of vehicles --------------------------------------------------------------------------------------------


def send(world: BookWorld, keeper: str = "k", **fields: Any) -> Goals | str | None:
    """The reply of the keeper, or its refusal."""
    order = SendVehicle(**fields, stamp_ns=world.now_ns)
    answer: Goals | str | None = answer_of(world, world.person, SEND_VEHICLE, order, keeper=keeper)
    world.run(0.2)
    return answer


def test_acknowledged_goals_are_on_the_disk_and_so_is_what_the_vehicle_has_reached(tmp_path: Path) -> None:
    world = BookWorld()
    path = tmp_path / "map.sqlite"
    with KeeperStore(path) as store:
        world.keeper("k", store)
        given = send(world, vehicle="a0-00", places=["cell:5,6", "cell:7,8"], then="chase")
        world.kill("k.1")
    with KeeperStore(path) as store:
        assert store.goals() == [given.given]
        world.keeper("k", store, 2)
        agent = world.bus("agent")
        done = GoalState(name="a0-00", stamp_ns=given.given.stamp_ns, done=1, state="underway")
        old = replace(done, stamp_ns=done.stamp_ns - 1, done=2)
        agent.publish(GOAL_STATES, GoalStates(agent="a0", stamp_ns=1, states=[done, old]), agent="a0")
        world.run(1.5)
        world.kill("k.2")
    with KeeperStore(path) as store:
        assert store.goals() == [replace(given.given, done=1)]
        assert [divmod(cell, 30) for cell in given.given.cells] == [(5, 6), (7, 8)]


def test_an_agent_hears_its_own_goals_alone_and_keepers_share_all() -> None:
    world = BookWorld(scenario="[[targets]]\n[[groups]]\nvehicles = 4\n[vehicles]\nper_agent = 2")
    stores = [KeeperStore(":memory:"), KeeperStore(":memory:")]
    world.keeper("k", stores[0])
    heard: list[Event] = []
    world.bus("agent").subscribe(GOALS, heard.append, agent="a0")
    send(world, vehicle="a0-00", places=["cell:5,6"])
    send(world, vehicle="a1-00", places=["cell:5,6", "cell:9,9"])
    world.keeper("l", stores[1])
    send(world, "l", vehicle="a1-01", places=["cell:9,9"])
    world.run(2.5)
    assert stores[0].goals() == stores[1].goals()
    assert [goals.name for goals in stores[0].goals()] == ["a0-00", "a1-00", "a1-01"]
    told = heard[-1]
    assert [goals.name for goals in told.message.goals] == ["a0-00"]
    assert told.message.shared == [(5 * 30 + 6, 2)]  # of all agents, as the vehicles need room there
    send(world, "l", vehicle="a1-00", off=True)
    world.run(1.5)
    assert stores[0].goals() == stores[1].goals()
    assert heard[-1].message.shared == []


@pytest.mark.parametrize(
    ("order", "words"),
    [
        ({"vehicle": "a9-00", "places": ["cell:5,6"]}, "vehicle 'a9-00': there is none"),
        ({"vehicle": "a0-00", "places": ["cell:50,6"]}, "outside the terrain"),
        ({"vehicle": "a0-00", "places": ["cell:3,4"]}, "[3, 4] is lethal"),
        ({"vehicle": "a0-00", "places": ["cell:5,6", "cell:5,6"], "then": "repeat"}, "two different places"),
    ],
)
def test_an_impossible_goal_is_refused_in_a_sentence(order: dict[str, Any], words: str, world: BookWorld) -> None:
    store = KeeperStore(":memory:")
    world.keeper("k", store)
    refused = send(world, **order)
    assert words in refused
    assert store.goals() == []
