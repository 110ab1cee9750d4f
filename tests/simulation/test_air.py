"""Vehicles that fly beside those that drive: each layer has its own right of way, and no law breaks in either."""

import itertools
import math
import statistics

import numpy as np
import pytest
from support.simulated import DRONE, WINDY, OrderedSimulation, agents, captures_by_class, cells, made, vehicles

from launch_scripts.simulation.laws import LawBook
from launch_scripts.simulation.simulate import Node
from shared_map.vehicle_class_grounds import class_grounds, clearance_floor
from swarm.config.scenario_files import parse_scenario
from swarm.wire.messages.orders import ZoneOrder

SECONDS = 12.0
_TEXT = """
name = "aloft"
seed = 3
time_scale = 30.0
terrain = { source = "synthetic", rows = 64, cols = 64, relief_m = 300.0, hidden = { rubble_fields = 6 } }
[[targets]]
count = 4
speed_m_per_s = 2.0
[[groups]]
name = "rovers"
targets = ["t0", "t1"]
vehicles = 12
[[groups]]
name = "drones"
targets = ["t2", "t3"]
class = "drone"
vehicles = 12
[vehicles]
per_agent = 4
sense_range_m = 60.0
capture_range_m = 30.0
"""
_TEXT += (
    f"{DRONE}no_fly = [{{ kind = 'forbidden', polygon_m = [[200, 200], [300, 200], [300, 300], [200, 300]] }}]\n"
)


@pytest.mark.parametrize("added", ["", WINDY], ids=["still", "windy"])
def test_what_flies_and_what_drives_share_cells_and_neither_waits_for_the_other(added: str) -> None:
    scenario, terrain = made(_TEXT + added)
    simulation = OrderedSimulation(scenario, terrain=terrain)
    flown: set[int] = set()
    together = 0

    def look(node: Node) -> None:
        nonlocal together
        aloft = set(cells(simulation, "drone").values())
        flown.update(aloft)
        together += len(aloft & set(cells(simulation, "ground").values()))

    simulation.after_tick.append(look)
    simulation.run_until(SECONDS - 1.0)
    shards = {
        (each.agent.plan.group.vehicle_class, each._right_of_way.core.shards.all.start > 0)
        for each in agents(simulation).values()
    }
    assert shards == {("ground", False), ("drone", True)}
    assert LawBook(simulation).run(SECONDS) == []
    report = simulation.report(SECONDS)
    assert report["collisions"] == report["lethal_entries"] == 0
    assert together > 0, "nobody flew over anybody"
    assert min(captures_by_class(simulation).values()) > 0
    ground = class_grounds(scenario, terrain, simulation.truth)["drone"].terrain
    assert ground.flight_m is not None
    floor_m = clearance_floor(terrain.elevation_m, 40.0)
    assert (ground.flight_m.ravel()[list(flown)] >= floor_m.ravel()[list(flown)]).all()
    rows, cols = np.divmod(np.array(list(flown)), terrain.grid.cols)
    assert not ((rows >= 7) & (rows < 10) & (cols >= 7) & (cols < 10)).any(), "a drone flew where it must not"
    assert np.isinf(ground.pace_s_per_m[7:10, 7:10]).all()
    assert np.isinf(terrain.pace_s_per_m.ravel()[list(flown)]).any(), "a drone flies where no rover drives"


_PLAIN = """
name = "plain"
terrain = { source = "synthetic", rows = 48, cols = 64, resolution_m = 10.0, relief_m = 0.0 }
targets = [{ walk = "still", start = END }]
groups = [{ name = "drones", class = "drone", vehicles = 1, cells = [START] }]
classes = [{ name = "drone", air = { speed_m_per_s = 12.0 } }]
wind = { speed_m_per_s = 6.0, from_deg = 270.0 }
planner = { routes = "ROUTES" }
vehicles = { capture_range_m = 5.0, reserve_cells = 8 }
"""
WEST, EAST, SOUTH_EAST = (9, 9), (9, 52), (45, 45)


def speed_mps(routes: str, start: tuple[int, int], end: tuple[int, int]) -> float:
    """Median speed of a drone over the ground on its way, over its ticks."""
    text = _PLAIN.replace("START", str([*start])).replace("END", str([*end])).replace("ROUTES", routes)
    simulation = OrderedSimulation(parse_scenario(text))
    places: list[tuple[float, float, float]] = []

    def look(node: Node) -> None:
        if node.spec.role == "agent":
            places.extend((simulation.now_s, *each.motion.place_m()) for each in vehicles(simulation).values())

    simulation.after_tick.append(look)
    simulation.run_until(20.0)
    speeds = [math.dist(a[1:], b[1:]) / (b[0] - a[0]) for a, b in itertools.pairwise(places)]
    return statistics.median(speed for speed in speeds if speed)


@pytest.mark.parametrize("routes", ["grid", "pulled"])
def test_the_wind_says_how_fast_a_drone_is_over_the_ground_in_each_direction(routes: str) -> None:
    """12 m/s through the air, in a wind of 6 m/s from the west."""
    assert speed_mps(routes, WEST, EAST) == pytest.approx(18.0, rel=0.01)
    assert speed_mps(routes, EAST, WEST) == pytest.approx(6.0, rel=0.01)
    across = math.sqrt(0.5) * 6.0
    assert speed_mps(routes, WEST, SOUTH_EAST) == pytest.approx(math.sqrt(12**2 - across**2) + across, rel=0.01)


def test_an_operators_zone_for_a_class_that_flies_is_a_no_fly_zone_and_rovers_go_on_below() -> None:
    scenario, terrain = made(_TEXT)
    simulation = OrderedSimulation(scenario, terrain=terrain)

    def inside(name: str) -> int:
        return int(zone.ravel()[list(cells(simulation, name).values())].sum())

    zone = np.zeros((64, 64), bool)
    zone[20:50, 20:50] = True
    corners = [(20.0, 20.0), (20.0, 50.0), (50.0, 50.0), (50.0, 20.0)]
    simulation.run_until(3.0)
    assert inside("drone") > 0
    simulation.order(3.0, ZoneOrder(action="add", name="z", polygon=corners, vehicle_class="drone"))
    simulation.run_until(10.0)
    assert inside("drone") == 0
    assert inside("ground") > 0
