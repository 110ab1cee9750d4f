"""A request is kept until something that it was made of changes, and no longer."""

import random
from collections.abc import Callable

import numpy as np
import pytest

from swarm.clock import NS_PER_S
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec, Window
from swarm.right_of_way.holdings import CellRequest
from swarm.wire.messages.vehicles import Obstacle
from vehicle_agent.driving.driven_vehicle import GivenRoute, Vehicle
from vehicle_agent.traffic.next_cells import FAR_CELLS, CellRequests, Steering
from vehicle_agent.traffic.obstacles import Obstacles

GRID = GridSpec(24, 24, 10.0, 0.0, 240.0)
TICK_NS = NS_PER_S // 10
RESERVE = 1


class Held:
    """The part of a host's holdings that `CellRequests` reads."""

    def __init__(self) -> None:
        self.paths: dict[str, list[int]] = {}
        self.pushed: dict[str, int] = {}
        self.others: set[int] = set()

    def occupied(self) -> set[int]:
        return self.others.union(*self.paths.values())


class Place:
    """A few vehicles on a small map; each call of `change` changes one thing of which requests are made."""

    def __init__(self, seed: int) -> None:
        self.chance = random.Random(seed)
        self.now_ns = self.chance.randrange(10 * NS_PER_S)
        self.pace = np.full((GRID.rows, GRID.cols), 0.1, np.float32)
        self.held = Held()
        self.obstacles = Obstacles(GRID, 2.0)
        self.obstacles.tick(self.now_ns)
        self.steering = Steering(GRID, self.pace, PlannerConfig(), RESERVE, self.obstacles)
        self.target = GRID.cell(12, 12)
        self.requests = CellRequests(
            self.steering,
            self.held,  # type: ignore[arg-type]
            2 * FAR_CELLS + 2,
            lambda target: self.target,
            lambda target, cell: GRID.distance_cells(cell, self.target) < 3,
            str(seed),
        )
        self.vehicles = []
        for n, cell in enumerate(self.chance.sample(range(GRID.cells), 12)):
            vehicle = Vehicle(f"a0-{n:02}", GRID, cell)
            vehicle.assign("t", 0)
            self.vehicles.append(vehicle)
            self.held.paths[vehicle.id] = [cell]
        self.seq = 0

    def walk(self, cell: int, steps: int) -> list[int]:
        cells = [cell]
        for _ in range(steps):
            cells.append(self.chance.choice([each for _, each in GRID.neighbours(cells[-1]) if each not in cells]))
        return cells

    def grant(self) -> None:
        vehicle = self.chance.choice(self.vehicles)
        self.held.paths[vehicle.id] = self.walk(vehicle.cell, self.chance.randrange(3))

    def route(self) -> None:
        vehicle = self.chance.choice(self.vehicles)
        path = self.held.paths[vehicle.id]
        route = GivenRoute("t", tuple(self.walk(path[-1], 6)), 1.0, 1.0, partial=False)
        vehicle.give_route(route, path, self.now_ns)

    def pass_a_cell(self) -> None:
        vehicle = self.chance.choice(self.vehicles)
        vehicle.route.moved(self.chance.choice(vehicle.route.near(4) or [0]))

    def others(self) -> None:
        vehicle = self.chance.choice(self.vehicles)
        self.held.others ^= {self.chance.choice(self.walk(vehicle.cell, 1))}

    def ground(self) -> None:
        row, col = divmod(self.chance.choice(self.vehicles).cell, GRID.cols)
        row = min(max(row + self.chance.randint(-3, 3), 0), GRID.rows - 1)
        col = min(max(col + self.chance.randint(-3, 3), 0), GRID.cols - 1)
        self.pace[row, col] = self.chance.choice((0.1, np.inf, 0.4))
        self.requests.ground_changed([Window(row, col, row + 1, col + 1)])

    def obstacle(self) -> None:
        x_m, y_m = GRID.centre_m(self.chance.choice(self.vehicles).cell)
        self.seq += 1
        report = Obstacle(
            id=f"b{self.chance.randrange(3)}",
            incarnation=1,
            seq=self.seq,
            stamp_ns=0,
            x_m=min(max(x_m + self.chance.uniform(-90, 90), 1.0), 239.0),
            y_m=min(max(y_m + self.chance.uniform(-90, 90), 1.0), 239.0),
            heading_rad=self.chance.choice((None, 1.0, -2.0)),
            speed_m_per_s=self.chance.choice((0.0, 3.0, 40.0)),
            radius_m=self.chance.uniform(1.0, 9.0),
            lease_s=self.chance.choice((0.3, 2.0)),
        )
        self.obstacles.take_report(report, self.now_ns)

    def push(self) -> None:
        self.held.pushed[self.chance.choice(self.vehicles).id] = self.chance.choice((0, 900))

    def reach(self) -> None:
        vehicle = self.chance.choice(self.vehicles)
        vehicle.set_in_reach(not vehicle.in_reach)

    def move_target(self) -> None:
        self.target = self.chance.choice(self.walk(self.chance.choice(self.vehicles).cell, 1))

    def zone(self) -> None:
        cells = [vehicle.cell for vehicle in self.vehicles[: self.chance.randrange(3)]]
        self.steering.exit_steps = dict.fromkeys(cells, 2)
        self.requests.make_anew()

    def wait(self) -> None:
        self.now_ns += TICK_NS
        self.obstacles.tick(self.now_ns)

    @property
    def changes(self) -> list[Callable[[], None]]:
        some = [self.grant, self.route, self.pass_a_cell, self.others, self.ground, self.obstacle]
        return [*some, self.push, self.reach, self.move_target, self.zone, *[self.wait] * 12, *[self.obstacle] * 3]


@pytest.mark.parametrize("seed", range(6))
def test_whatever_changes_the_wishes_that_are_kept_are_those_that_would_be_made_again(seed):
    place = Place(seed)
    requests, kept = place.requests, 0
    for _ in range(300):
        before = dict(requests._made_of)
        place.chance.choice(place.changes)()
        requests.drop_near_changes(place.vehicles)
        requests.make(place.vehicles, place.now_ns)
        kept += sum(before.get(id) is made_of for id, made_of in requests._made_of.items())
        told = dict(requests.of)
        requests.make_anew()
        requests.make(place.vehicles, place.now_ns)
        assert requests.of == told
        assert all(requests.of[id] is request for id, request in told.items())
    assert kept > 1500


def test_one_that_stands_or_leaves_leaves_nothing_behind():
    place = Place(1)
    requests = place.requests
    requests.make(place.vehicles, place.now_ns)
    first, *others = place.vehicles
    requests.stay(first.id)
    assert requests.of[first.id] == CellRequest()
    requests.make(place.vehicles, place.now_ns)
    assert requests.of[first.id] != CellRequest()
    for vehicle in place.vehicles:
        requests.forget(vehicle.id)
    assert not any((requests.of, requests._made_of, requests._beside, requests._since_ns))
    assert others
