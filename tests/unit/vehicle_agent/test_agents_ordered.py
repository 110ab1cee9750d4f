"""Agents end to end on a simulated network, with a keeper: vehicles that operators send to places; zones, which a
vehicle inside leaves and no other enters."""

import random
from collections import Counter
from typing import Any

import pytest
from msgspec.structs import replace
from support.agent_world import OPEN, AgentWorld, pace_of, scenario
from support.bus_world import answer_of
from support.planner_swarm import planning

from planner_service.places_service import PlacesService
from shared_map.keeper.mark_store import KeeperStore
from swarm.bus.bus import Event
from swarm.wire.messages import Message
from swarm.wire.messages.orders import GiveOrder, GoalState, SendVehicle, Then, ZoneOrder
from swarm.wire.messages.vehicles import Obstacle, VehicleState
from swarm.wire.topics import GIVE_ORDER, GOAL_STATES, OBSTACLE, SEND_VEHICLE, ZONES, Topic


class KeptWorld(AgentWorld):
    """Agents, and a keeper that takes orders."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.keeper("k", KeeperStore(":memory:"))

    def ask(self, topic: Topic, order: GiveOrder | SendVehicle | ZoneOrder) -> None:
        """Gives an order, which the keeper acknowledges."""
        order = replace(order, stamp_ns=self.now_ns)
        assert isinstance(answer_of(self, self._watch, topic, order, keeper="k"), Message)


# --- vehicles that are sent to places -------------------------------------------------------------------------


class SentWorld(KeptWorld):
    """Beside these a target, and a process that plans to places.

    progress  vehicle -> its newest state as its agent has told it
    """

    def __init__(self, text: str, picture: list[str]) -> None:
        super().__init__(text, pace_of(picture))
        plans = planning(self, "places", "all")
        self.start("places", lambda bus, post: PlacesService(plans(bus, post)))
        self.progress: dict[str, GoalState] = {}
        self._watch.subscribe(GOAL_STATES, self._told)
        self.begin(t=(1, 1))
        self.until(lambda: len(self.vehicles()) == self.scenario.vehicle_count, within_s=20)

    def _told(self, event: Event) -> None:
        self.progress.update({each.name: each for each in event.message.states})

    def send(self, vehicle: str, *places: tuple[int, int], then: Then = "hold") -> None:
        named = ["cell:{},{}".format(*place) for place in places]
        self.ask(SEND_VEHICLE, SendVehicle(vehicle=vehicle, places=named, then=then))

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
    world.ask(GIVE_ORDER, GiveOrder(subject="vehicle", name="a0-00"))
    world.until(lambda: world.states_of_goals() == {"standby": 1}, within_s=5)
    world.ask(GIVE_ORDER, GiveOrder(subject="vehicle", name="a0-00", off=True))
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


@pytest.mark.parametrize("then", ["hold", "repeat"])
def test_no_place_counts_as_reached_before_the_vehicle_is_there(then: Then) -> None:
    starts = [(3 * n + 1, 5) for n in range(6)]
    # So slow a tick that agents act on messages between two.
    world = SentWorld(scenario(6, starts).replace("seed = 3", "seed = 3\ntime_scale = 8"), OPEN)
    chance, grid = random.Random(4), world.terrain.grid
    done: dict[tuple[str, int], int] = {}
    reached: list[tuple[int, int]] = []

    def look() -> None:
        for goals in (each for service in world.agents.values() for each in service.agent.goals.book):
            for n in range(done.get((goals.name, goals.stamp_ns), 0), goals.done):
                reached.append((goals.cells[n % len(goals.cells)], grid.cell(*world.where()[goals.name])))
            done[goals.name, goals.stamp_ns] = goals.done

    world.after_tick.append(look)
    for _ in range(8):
        for vehicle, (row, _) in zip(sorted(world.where()), starts, strict=True):
            col = chance.randrange(2, 18)
            world.send(vehicle, (row, col), (row, col + 1), (row - 1, col), then=then)
            world.run(chance.random())
        world.run(3.0)
    assert len(reached) > 100
    assert [(place, cell) for place, cell in reached if place != cell] == []


# --- zones --------------------------------------------------------------------------------------------------


class ClosedWorld(KeptWorld):
    """Looks at each tick who enters or leaves a zone."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.entered: list[str] = []
        self._closed: set[int] = set()
        self._inside: dict[str, int] = {}
        self.after_tick.append(self._watch_borders)

    def close(self, row0: int, col0: int, row1: int, col1: int) -> None:
        corners: Any = [(row0, col0), (row0, col1), (row1, col1), (row1, col0)]
        self.ask(ZONES, ZoneOrder(action="add", name="z", polygon=corners))
        self.run(0.5)
        cols = self.terrain.grid.cols
        self._closed = {row * cols + col for row in range(row0, row1) for col in range(col0, col1)}
        self._inside = {vehicle.id: vehicle.cell for vehicle in self.vehicles() if vehicle.cell in self._closed}

    def assert_all_leave(self) -> None:
        self.until(lambda: not self._inside, within_s=30)
        assert self.entered == []
        self.assert_lawful()

    def _watch_borders(self) -> None:
        inside = {vehicle.id: vehicle.cell for vehicle in self.vehicles() if vehicle.cell in self._closed}
        self.entered += inside.keys() - self._inside.keys() if self._closed else ()
        self._inside = inside


def test_vehicles_drive_out_of_a_zone_and_no_one_drives_in() -> None:
    inside = [(row, col) for row in (7, 8, 9, 10) for col in (7, 8, 9, 10)]
    world = ClosedWorld(scenario(len(inside), inside, per_agent=4, capture=15.0), pace_of(OPEN)).begin(t=(9, 9))
    world.run(3.0)
    world.close(5, 5, 13, 13)
    world.until(lambda: not world._inside, within_s=30)
    world.put_target("t", 9, 18, jumped=True)
    # Nine places are within reach of it.
    world.until(lambda: list(world.states().values()).count(VehicleState.ARRIVED) >= 6, within_s=60)
    assert world.entered == []
    world.assert_lawful()


def test_what_is_seen_in_a_zone_is_not_marked() -> None:
    world = ClosedWorld(scenario(1, [(10, 2)]), pace_of(OPEN)).begin(t=(10, 12))
    world.run(1.0)
    world.close(0, 6, 18, 8)
    world.arrive(60)
    assert world.count("marks") == 0
    assert world.entered == []


def test_inflated_borders_of_a_zone_are_left_too_and_walls_are_not_crossed() -> None:
    picture = ["." * 20 for _ in range(20)]
    for row in range(6, 12):
        picture[row] = picture[row][:10] + "#" + picture[row][11:]
    world = ClosedWorld(scenario(2, [(8, 9), (9, 11)], per_agent=1), pace_of(picture)).begin(t=(8, 19))
    world.run(0.5)
    world.close(5, 6, 13, 15)
    world.assert_all_leave()


def test_a_way_out_does_not_lead_over_ground_that_is_seen_to_be_lethal() -> None:
    """By the map all of a zone is lethal, so the map does not show which cells are lethal in truth, and no vehicle
    marks them there."""
    truth = ["." * 20 for _ in range(20)]
    for row in (7, 8):  # further than the vehicle sees from where it starts
        truth[row] = "." * 6 + "#" * 9 + "." * 5
    world = ClosedWorld(scenario(1, [(14, 10)], per_agent=1), pace_of(OPEN), truth=pace_of(truth)).begin(t=(14, 10))
    world.run(0.5)
    world.close(6, 0, 20, 20)
    world.assert_all_leave()


def test_a_way_out_leads_around_an_obstacle_that_stands_on_the_nearest() -> None:
    world = ClosedWorld(scenario(1, [(10, 10)], per_agent=1), pace_of(OPEN)).begin(t=(10, 10))
    grid = world.terrain.grid
    side_m = grid.resolution_m
    x_m, y_m = grid.west_m + 10.5 * side_m, grid.north_m - 9.5 * side_m
    seq = iter(range(1, 1000))

    def report() -> None:
        obstacle = Obstacle(
            id="r", incarnation=1, seq=next(seq), x_m=x_m, y_m=y_m, radius_m=0.3 * side_m, lease_s=1.0
        )
        world._watch.publish(OBSTACLE, obstacle, id="r")

    for _ in range(10):
        report()
        world.run(0.2)
    world.close(9, 4, 17, 17)
    for _ in range(100):
        report()
        world.run(0.2)
    assert not world._inside
    assert world.entered == []
    world.assert_lawful()
