"""Simulated rovers: they say where they go before they set out, keep to the ground, and go on after a take-over."""

from __future__ import annotations

import itertools
import math

import msgspec
import numpy as np
import pytest

from launch_scripts.process_table import processes_of
from launch_scripts.simulation.world.rovers import Rovers
from launch_scripts.simulation.world.walks import TrueTerrain
from swarm.clock import NS_PER_S
from swarm.config.load import parse_scenario
from swarm.config.scenario import Scenario
from swarm.errors import ConfigError
from swarm.grid import GridSpec
from swarm.wire.messages.vehicles import Body
from vehicle_agent.bodies import REACTION_S, capsule_of

GRID = GridSpec(30, 30, 10.0)
TICK = NS_PER_S // 10
TEXT = """
seed = 4
time_scale = 2
[[rovers]]
count = 6
speed_m_per_s = 3
radius_m = 2
"""


def ground() -> TrueTerrain:
    pace = np.full((30, 30), 0.1, np.float32)
    pace[10:12, 5:25] = np.inf
    return TrueTerrain(GRID, pace)


@pytest.fixture
def scenario() -> Scenario:
    return parse_scenario(TEXT)


def driven(rovers: Rovers, seconds: float, time_scale: float = 2.0) -> list[dict[str, Body]]:
    """The last pose of each rover, tick by tick."""
    told: dict[str, Body] = {}
    ticks = []
    for tick in range(int(seconds * 10)):
        told |= {body.id: body for body in rovers.tick(time_scale, tick * TICK)}
        ticks.append(dict(told))
    return ticks


def test_a_rover_is_always_where_its_last_word_said_that_it_would_be(scenario: Scenario) -> None:
    ticks = driven(Rovers(scenario, ground(), 1), 60.0)
    moved = 0
    for before, after in itertools.pairwise(ticks):
        for id, body in after.items():
            said = before[id]
            reach = capsule_of(said, GRID, said.speed_m_per_s * REACTION_S, margin_m=0.01)
            far_m = math.hypot(body.x_m - said.x_m, body.y_m - said.y_m)
            moved += far_m > 0
            assert far_m <= math.hypot(reach.east_m, reach.north_m) + 1e-6
            along = (body.x_m - said.x_m) * reach.north_m - (body.y_m - said.y_m) * reach.east_m
            assert abs(along) < 1e-6 * max(far_m, 1.0) * max(math.hypot(reach.east_m, reach.north_m), 1.0)
    assert moved > 1000


def test_rovers_keep_to_the_ground_and_stop_at_times(scenario: Scenario) -> None:
    terrain = ground()
    ticks = driven(Rovers(scenario, terrain, 1), 60.0)
    bodies = [body for told in ticks for body in told.values()]
    assert not any(terrain.lethal(int(-body.y_m // 10) * 30 + int(body.x_m // 10)) for body in bodies)
    assert {body.speed_m_per_s for body in bodies} == {0.0, 6.0}


def test_one_that_takes_over_goes_on_from_where_the_other_was(scenario: Scenario) -> None:
    ticks = driven(Rovers(scenario, ground(), 1), 20.0)
    second = Rovers(scenario, ground(), 2)
    for body in ticks[-1].values():
        second.note_body(body)
    second.note_body(msgspec.structs.replace(ticks[-1]["r0"], id="nobody"))
    for id, body in driven(second, 0.1)[0].items():
        last = ticks[-1][id]
        assert (body.x_m, body.y_m) == (last.x_m, last.y_m)
        assert (body.incarnation, body.seq) == (2, last.seq + 1)


def test_rovers_stand_while_the_run_is_paused(scenario: Scenario) -> None:
    ticks = driven(Rovers(scenario, ground(), 1), 3.0, time_scale=0.0)
    assert {(body.x_m, body.y_m, body.speed_m_per_s) for body in ticks[-1].values()} == {
        (body.x_m, body.y_m, 0.0) for body in ticks[0].values()
    }


def test_rovers_need_the_process_that_moves_them_and_names_of_their_own(scenario: Scenario) -> None:
    external = parse_scenario(TEXT + '[[targets]]\nwalk = "external"\n')
    assert any(spec.role == "targets" for spec in processes_of(external))
    with pytest.raises(ConfigError, match="two rovers are called 'r0'"):
        parse_scenario(TEXT + '[[rovers]]\nname = "r0"\n')
