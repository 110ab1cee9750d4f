"""The keeper's book of orders: what it acknowledges is on its disk, and every keeper comes to hold it."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.swarm_model import SwarmModel

from shared_map.keeper.mark_store import KeeperStore
from shared_map.terrain.terrain import terrain_of_pace
from swarm.bus.bus import AskEnded, Event, Replied
from swarm.config.load import parse_scenario
from swarm.grid import GridSpec
from swarm.liveness import Peer
from swarm.wire.codec import decode, encode
from swarm.wire.messages.orders import GiveOrder, Order, Orders
from swarm.wire.topics import GIVE_ORDER

PACE = np.ones((20, 30), np.float32)
PACE[3, 4] = np.inf


class BookWorld(SwarmModel):
    """Keepers, and a person who gives orders."""

    def __init__(self, grid: GridSpec | None = None) -> None:
        scenario = parse_scenario("[[targets]]\ncount = 2\n[[groups]]\nvehicles = 2")
        terrain = terrain_of_pace(PACE)
        terrain = terrain if grid is None else dataclasses.replace(terrain, grid=grid)
        super().__init__(terrain=terrain, scenario=scenario)
        self.person = self.bus("person")

    def give(self, keeper: str = "k", **fields: Any) -> list[Order] | str | None:
        """The book of the keeper after that, or its refusal."""
        heard: list[Event] = []
        self.person.ask(GIVE_ORDER, GiveOrder(**fields, stamp_ns=self.now_ns), heard.append, tag="o", keeper=keeper)
        self.run(0.2)
        for event in heard:
            if isinstance(event, Replied):
                assert isinstance(event.message, Orders)
                return event.message.orders
        (ended,) = (event for event in heard if isinstance(event, AskEnded))
        return ended.failure


def test_an_acknowledged_order_is_on_the_disk(tmp_path: Path) -> None:
    world = BookWorld()
    with KeeperStore(tmp_path / "map.sqlite") as store:
        world.keeper("k", store)
        assert isinstance(world.give(subject="pause"), list)
        world.kill("k.1")
    with KeeperStore(tmp_path / "map.sqlite") as store:
        world.keeper("k", store, 2)
        (order,) = world.give() or ()
        assert isinstance(order, Order)
        assert (order.subject, order.off) == ("pause", False)


def test_a_keeper_with_a_new_store_learns_what_is_ordered_and_keepers_agree() -> None:
    world = BookWorld()
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


def test_a_store_that_cannot_be_written_acknowledges_nothing() -> None:
    world = BookWorld()
    store = KeeperStore(":memory:")
    world.keeper("k", store)
    store._db.execute("PRAGMA query_only = 1")
    refusal = world.give(subject="pause")
    assert isinstance(refusal, str)
    assert "cannot write the store" in refusal
    assert world.give() == []
    store._db.execute("PRAGMA query_only = 0")
    assert isinstance(world.give(subject="pause"), list)


def test_a_target_is_put_on_passable_ground_of_the_terrain_only() -> None:
    world = BookWorld()
    world.keeper("k", KeeperStore(":memory:"))
    assert world.give(subject="target", name="x", row=3, col=4, new=True) == "target x: [3, 4] is lethal"
    outside = world.give(subject="target", name="x", row=-1, col=4, new=True)
    assert isinstance(outside, str)
    assert "is not in 20 x 30 cells" in outside
    assert isinstance(world.give(subject="target", name="x", row=3, col=5, new=True), list)


def test_vehicles_of_agents_that_joined_later_are_stopped_too() -> None:
    world = BookWorld()
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
    assert isinstance(given, Order)
    assert given.cell == 95
    refusal = world.give(subject="target", name="y", at="47.5,9.0", new=True)
    assert "target y: at is '47.5,9.0', outside the terrain: latitude 46.9" in str(refusal)
    for wrong in ({"at": "there"}, {"at": "1,1", "cell": 3}, {}):
        with pytest.raises(ValueError, match=r"at is 'there'|give either cell|or at"):
            GiveOrder(subject="target", name="x", **wrong).relate()
