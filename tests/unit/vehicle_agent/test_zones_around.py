"""Vehicles and zones: a vehicle inside one drives out, none drives in, and its observations there are no news."""

from typing import Any

from support.agent_world import OPEN, AgentWorld, pace_of, scenario
from support.bus_world import answer_of

from shared_map.keeper.mark_store import KeeperStore
from swarm.wire.messages.orders import ZoneOrder, Zones
from swarm.wire.messages.vehicles import Obstacle, VehicleState
from swarm.wire.topics import OBSTACLE, ZONES


class ClosedWorld(AgentWorld):
    """Agents, and a keeper that takes orders."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.keeper("k", KeeperStore(":memory:"))
        self.entered: list[str] = []
        self._closed: set[int] = set()
        self._inside: dict[str, int] = {}
        self.after_tick.append(self._watch_borders)

    def close(self, row0: int, col0: int, row1: int, col1: int) -> None:
        corners: Any = [(row0, col0), (row0, col1), (row1, col1), (row1, col0)]
        order = ZoneOrder(action="add", name="z", polygon=corners, stamp_ns=self.now_ns)
        assert isinstance(answer_of(self, self._watch, ZONES, order, keeper="k"), Zones)
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
