"""Agents end to end on a simulated network: they follow, find out, mark, and come back from the dead."""

import numpy as np
import pytest
from support.agent_world import CLOSED_FORK, FORK, OPEN, AgentWorld, pace_of, scenario

from swarm.bus.bus import LinkChanged
from swarm.clock import NS_PER_S
from swarm.errors import ConfigError
from swarm.wire.messages.processes import Stats
from swarm.wire.messages.vehicles import Obstacle, VehicleState
from swarm.wire.topics import OBSTACLE, STATS


def test_vehicles_drive_to_the_target_and_arrive_as_soon_as_the_pace_allows() -> None:
    world = AgentWorld(scenario(1, [(10, 2)]), pace_of(OPEN)).begin(t=(10, 12))
    took_s = world.arrive(30)
    # 9 cells of 10 m at 0.1 s/m to come within 10 m of the target, and at most a second to get going.
    assert 8.5 <= took_s <= 11.5  # with a second in which it listens for obstacles
    assert world.where() == {"a0-00": (10, 11)}


def test_a_vehicle_that_finds_the_road_closed_marks_it_and_takes_another() -> None:
    prior = [
        "###############",
        "#.............#",
        "#.###########.#",
        "#.............#",
        "###############",
    ]
    truth = list(prior)
    truth[1] = "#......#......#"
    world = AgentWorld(scenario(1, [(1, 1)]), pace_of(prior), pace_of(truth)).begin(t=(1, 13))
    world.arrive(60)
    assert world.count("marks") == 1
    assert world.count("reroute_requests") >= 1
    assert np.isinf(world.agents["a0"]._maps.common.ground_s_per_m[1, 7])


def test_a_vehicle_that_an_obstacle_shuts_in_raises_an_alarm_until_the_obstacle_leaves() -> None:
    world = AgentWorld(scenario(1, [(1, 1)]), pace_of(["#" * 9, "#.......#", "#" * 9]))
    world.put_target("t", 1, 7)
    person, (x_m, y_m) = world.bus("person"), world.terrain.grid.centre_m(world.terrain.grid.cell(1, 2))
    stats: list[Stats] = []
    world.bus("observer").subscribe(STATS, lambda event: stats.append(event.message))  # type: ignore[union-attr, arg-type]

    def tell(seq: int, lease_s: float, x: float = x_m) -> None:
        obstacle = Obstacle(id="p", incarnation=1, seq=seq, x_m=x, y_m=y_m, radius_m=1.0, lease_s=lease_s)
        person.publish(OBSTACLE, obstacle, id="p")

    def alarms() -> list[tuple[str, int | None, bool]]:
        told = stats[-1].alarms if stats else []
        return [(each.about, each.cell, each.over_ns is None) for each in told if each.kind == "shut-in"]

    world.start_all()
    for seq in range(1, 51):
        tell(seq, 10.0, x_m + 40.0 * (seq % 2))  # leaps, of which only the last counts
    world.until(alarms, within_s=10)
    assert alarms() == [("a0-00", 10, True)]
    assert world.count("obstacles_refused") == 0, "a tick takes in one report of a sender"
    tell(51, 0.0)
    world.arrive(30)
    world.agents["a0"].handle(LinkChanged(up=True, beyond=True), world.now_ns)
    assert not world.agents["a0"].agent.obstacles.is_deaf, "tokens of routers, which anybody may raise, stop nobody"
    world.until(lambda: alarms() == [("a0-00", 10, False)])
    assert world.count("shut_in") == 1


def test_a_vehicle_that_drives_between_two_ticks_avoids_an_obstacle_that_has_come_meanwhile() -> None:
    world = AgentWorld(scenario(1, [(1, 1)]), pace_of(["#" * 20, f"#{'.' * 18}#", "#" * 20])).begin(t=(1, 18))
    service = world.agents["a0"]
    world.until(lambda: len(service.agent.holdings.path("a0-00")) > 4, within_s=10)
    cell = service.agent.holdings.path("a0-00")[1]
    x_m, y_m = world.terrain.grid.centre_m(cell)
    obstacle = Obstacle(id="p", incarnation=1, seq=1, x_m=x_m, y_m=y_m, radius_m=1.0, lease_s=10.0)
    world.bus("person").publish(OBSTACLE, obstacle, id="p")
    world.run(0.01)
    service._bus.gather()
    service._acted_ns, service._parts.act_ns = 1, 0
    service._act(world.now_ns + 8 * NS_PER_S)  # as after a stop of the process
    assert world.where()["a0-00"][1] < cell % 20


def test_marks_of_one_agent_spare_another_the_detour() -> None:
    world = AgentWorld(scenario(2, [(1, 10), (1, 2)], 1), pace_of(FORK), pace_of(CLOSED_FORK)).begin(t=(1, 17))
    world.arrive(90)
    # The second turned off at the branch: it never came within its sensor's three cells of the closure.
    assert [service.counters.counts["marks"] for service in world.agents.values()] == [1, 0]


def test_slow_ground_is_marked_and_driven_at_its_own_pace() -> None:
    truth = pace_of([".....~~~~....."])
    world = AgentWorld(scenario(1, [(0, 0)]), pace_of(["." * 14]), truth).begin(t=(0, 13))
    took_s = world.arrive(60)
    # 12 cells, four of them at three times the pace.
    assert 19.4 <= took_s <= 22.0
    assert world.count("marks") == 4


def test_routes_given_in_parts_are_driven_without_a_stop() -> None:
    text = scenario(1, [(10, 0)]) + "route_cells = 12\n"
    world = AgentWorld(text, pace_of(["." * 60] * 20)).begin(t=(10, 50))
    took_s = world.arrive(80)
    assert took_s <= 51.0
    assert world.count("reroute_requests") == 0


def test_a_walled_in_vehicle_is_stranded_until_the_wall_is_known_to_be_open() -> None:
    prior = ["." * 12] * 3 + ["#" * 12] + ["." * 12] * 4
    world = AgentWorld(scenario(1, [(1, 1)]), pace_of(prior)).begin(t=(6, 6))
    world.until(lambda: world.all_in(VehicleState.STRANDED), within_s=5)
    world.run(0.2)
    assert world.agents["a0"].counters.gauges["stranded"] == 1.0
    world.put_target("t", 1, 8)
    world.arrive(20)


def test_the_first_to_start_does_not_wait_for_anybody() -> None:
    world = AgentWorld(scenario(4), pace_of(OPEN))
    world.put_target("t", 10, 10)
    world.start_planner("t")
    world.start_agent("a0")
    assert world.until(lambda: len(world.agents["a0"].agent.vehicles) == 2, within_s=1) <= 0.5
    # a1 never starts: its places stay free.
    world.run(20)
    world.assert_lawful()


# --- where they start ---------------------------------------------------------------------------------------


ROCK = [*OPEN[:3], "...#" + "." * 16, *OPEN[4:]]


@pytest.mark.parametrize(
    ("text", "picture", "agent", "words"),
    [
        (scenario(1, [(30, 2)]), ROCK, "a0", r"groups: all: cell is \[30, 2\], outside the terrain: 20 x 20 cells"),
        (scenario(1, [(3, 3)]), ROCK, "a0", r"groups: all: cell:3,3 .* is lethal; choose a passable cell"),
        (scenario(10), ["..."] * 3, "a0", "10 vehicles, but only 9 connected passable cells"),
        (scenario(2), OPEN, "a7", "has no agent a7"),
    ],
)
def test_an_agent_that_cannot_start_is_refused_in_a_sentence(text: str, picture: list[str], agent: str, words: str):
    world = AgentWorld(text, pace_of(picture))
    with pytest.raises(ConfigError, match=words):
        world.start_agent(agent)


# --- crowds and corridors, in which they make way for each other ----------------------------------------------

TWO_WAYS = """
seed = {seed}
targets = [{{ name = "west", walk = "still" }}, {{ name = "east", walk = "still" }}]
groups = [
    {{ name = "eastbound", vehicles = {count}, cells = {west_cells}, targets = ["east"] }},
    {{ name = "westbound", vehicles = {count}, cells = {east_cells}, targets = ["west"] }},
]
vehicles = {{ per_agent = {per_agent}, sense_range_m = 30.0, capture_range_m = {capture} }}
"""


@pytest.mark.parametrize("seed", range(4))
def test_a_corridor_with_one_passing_place_lets_two_pass_each_other(seed: int) -> None:
    corridor = ["#" * 21, "#" + "." * 19 + "#", "#" * 10 + "." + "#" * 10, "#" * 21]
    text = TWO_WAYS.format(seed=seed, count=1, west_cells=[[1, 2]], east_cells=[[1, 16]], per_agent=1, capture=10.0)
    world = AgentWorld(text, pace_of(corridor)).begin(west=(1, 1), east=(1, 19))
    world.arrive(120)


@pytest.mark.seeds(1)
def test_two_columns_pass_each_other_through_a_gap(seed: int) -> None:
    field = ["." * 9 + ("..." if row == 4 else "###") + "." * 9 for row in range(9)]
    west = [[row, col] for col in (1, 3) for row in (2, 4, 6)]
    east = [[row, 20 - col] for row, col in west]
    text = TWO_WAYS.format(seed=seed, count=6, west_cells=west, east_cells=east, per_agent=3, capture=25.0)
    world = AgentWorld(text, pace_of(field)).begin(west=(4, 2), east=(4, 18))
    world.arrive(300)


@pytest.mark.parametrize("seed", range(3))
def test_a_crowd_fits_around_its_target(seed: int) -> None:
    # 21 cells lie within 25 m of the target: room for all 16, if those in front move up.
    text = scenario(16, per_agent=4, capture=25.0).replace("seed = 3", f"seed = {seed}")
    world = AgentWorld(text, pace_of(OPEN)).begin(t=(10, 10))
    world.arrive(120)


def test_a_vehicle_that_has_arrived_in_a_corridor_moves_up_for_those_behind() -> None:
    corridor = ["#" * 16, "#" + "." * 14 + "#", "#" * 16]
    text = scenario(3, [(1, 5), (1, 3), (1, 1)], per_agent=1, capture=30.0)
    world = AgentWorld(text, pace_of(corridor)).begin(t=(1, 12))
    world.arrive(60)
