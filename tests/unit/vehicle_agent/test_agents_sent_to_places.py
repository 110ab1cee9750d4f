"""Agents end to end on a simulated network, with a keeper: vehicles that operators send to places."""

from collections import Counter
from typing import Any

from msgspec.structs import replace
from support.agent_world import AgentWorld, pace_of, scenario
from support.bus_world import answer_of
from support.planner_swarm import planning

from planner_service.places_service import PlacesService
from shared_map.keeper.mark_store import KeeperStore
from swarm.bus.bus import Event
from swarm.wire.messages import Message
from swarm.wire.messages.orders import GiveOrder, GoalState, SendVehicle, ZoneOrder
from swarm.wire.topics import GIVE_ORDER, GOAL_STATES, SEND_VEHICLE, ZONES, Topic


class SentWorld(AgentWorld):
    """Agents, a target, a keeper and a process that plans to places.

    progress  vehicle -> its newest state as its agent has told it
    """

    def __init__(self, text: str, picture: list[str]) -> None:
        super().__init__(text, pace_of(picture))
        self.store = KeeperStore(":memory:")
        self.keeper("k", self.store)
        plans = planning(self, "places", "all")
        self.start("places", lambda bus, post: PlacesService(plans(bus, post)))
        self.progress: dict[str, GoalState] = {}
        self.person = self.bus("person")
        self.person.subscribe(GOAL_STATES, self._told)
        self.begin(t=(1, 1))
        self.until(lambda: len(self.vehicles()) == self.scenario.vehicle_count, within_s=20)

    def _told(self, event: Event) -> None:
        self.progress.update({each.name: each for each in event.message.states})

    def send(self, vehicle: str, *places: tuple[int, int], **fields: Any) -> None:
        named = [f"cell:{row},{col}" for row, col in places]
        self.ask(SEND_VEHICLE, SendVehicle(vehicle=vehicle, places=named, stamp_ns=self.now_ns, **fields))

    def ask(self, topic: Topic, order: Message) -> None:
        """Gives an order, which the keeper acknowledges."""
        if isinstance(order, ZoneOrder):
            order = replace(order, stamp_ns=self.now_ns)
        assert isinstance(answer_of(self, self.person, topic, order, keeper="k"), Message)

    def states_of_goals(self) -> Counter[str]:
        return Counter(each.state for each in self.progress.values())


def test_a_vehicle_that_holds_makes_way_in_a_corridor_and_goes_back() -> None:
    corridor = ["#" * 21, "#" + "." * 19 + "#", "#" * 10 + "." + "#" * 10, "#" * 21]
    world = SentWorld(scenario(2, [(1, 3), (1, 5)], per_agent=1, capture=10.0), corridor)
    world.send("a1-00", (1, 9))
    world.until(lambda: world.states_of_goals() == {"completed": 1}, within_s=30)
    world.send("a0-00", (1, 17))
    world.until(lambda: world.states_of_goals() == {"completed": 2}, within_s=120)
    world.until(lambda: world.where()["a1-00"] == (1, 9), within_s=30)
    assert world.where()["a0-00"] == (1, 17)
    world.assert_lawful()


def test_a_place_without_a_way_blocks_until_there_is_one_and_a_stop_is_a_standby() -> None:
    gap = ["." * 20] * 10 + ["#" * 5 + "." + "#" * 14] + ["." * 20] * 9
    world = SentWorld(scenario(2, [(5, 5), (5, 7)]), gap)
    zone = ZoneOrder(action="add", name="gap", polygon=[(10, 4), (10, 7), (11, 7), (11, 4)])
    world.ask(ZONES, zone)
    world.run(1.0)
    world.send("a0-00", (15, 5))
    world.until(lambda: world.states_of_goals() == {"blocked": 1}, within_s=10)
    assert world.progress["a0-00"].reason == "no way leads there"
    alarms = world.agents["a0"]._member.alarms
    assert [(each.kind, each.about) for each in alarms.current()] == [("goal-blocked", "a0-00")]
    world.ask(ZONES, replace(zone, action="remove", polygon=[]))
    world.until(lambda: world.states_of_goals() == {"underway": 1}, within_s=10)
    world.ask(GIVE_ORDER, GiveOrder(subject="vehicle", name="a0-00", stamp_ns=world.now_ns))
    world.until(lambda: world.states_of_goals() == {"standby": 1}, within_s=5)
    world.ask(GIVE_ORDER, GiveOrder(subject="vehicle", name="a0-00", off=True, stamp_ns=world.now_ns))
    world.until(lambda: world.states_of_goals() == {"completed": 1}, within_s=60)
    assert all(each.over_ns is not None for each in alarms.current())
    world.assert_lawful()


def test_a_better_way_that_opens_is_taken_on_the_way() -> None:
    gap = ["." * 20] * 10 + ["#" * 5 + "." + "#" * 13 + "."] + ["." * 20] * 9
    world = SentWorld(scenario(2, [(2, 4), (2, 7)]).replace("seed = 3", "seed = 3\ntime_scale = 0.3"), gap)
    zone = ZoneOrder(action="add", name="gap", polygon=[(10, 4), (10, 7), (11, 7), (11, 4)])
    world.ask(ZONES, zone)
    world.run(1.0)
    world.send("a0-00", (18, 5))
    world.until(lambda: world.where()["a0-00"][1] >= 8, within_s=60)
    begun = len(world.followed)
    world.ask(ZONES, replace(zone, action="remove", polygon=[]))
    crossed: list[tuple[int, int]] = []
    world.after_tick.append(lambda: crossed.append(world.where()["a0-00"]))
    world.until(lambda: world.states_of_goals() == {"completed": 1}, within_s=300)
    assert (10, 5) in crossed
    routes = [each for each in world.followed[begun:] if each.vehicle == "a0-00"]
    assert len(routes) <= 3, "a route that is the rest of the one before is not begun anew"
