"""Vehicles driven at the speeds of a plug-in: never faster than the ground allows, never beyond their path."""

import math
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swarm.config.plugin_names import PLUGIN_KINDS, NamedPlugin
from swarm.config.vehicle_classes import ClassConfig
from swarm.grid import GridSpec
from swarm.plugins import Plugin
from vehicle_agent.driving.dynamics import DynamicsWorld, PluginDynamics, Stretch, dynamics_of, own_dynamics
from vehicle_agent.driving.motion import Motion

GRID = GridSpec(1, 30, 10.0)
PACE = 0.1
TICK_S = 0.1


def driven_by(speed: Any) -> tuple[PluginDynamics, list[str], list[Stretch]]:
    """Dynamics whose plug-in returns these speeds, its messages, and its calls."""
    told: list[str] = []
    asked: list[Stretch] = []

    class Says:
        def speed(self, stretch: Stretch) -> Any:
            asked.append(stretch)
            return speed(stretch)

    named = NamedPlugin(PLUGIN_KINDS["dynamics"], "vehicles.dynamics", "my:Own", {})
    made = dynamics_of(Plugin(named, lambda world, options: Says(), {}), DynamicsWorld("a0", GRID, 1), told.append)
    assert made is not None
    return made, told, asked


def drive(dynamics: PluginDynamics, motion: Motion, path: list[int], ticks: int) -> list[float]:
    """Metres from the west after each tick, of a vehicle that was granted this path."""
    places = []
    for _ in range(ticks):
        dynamics.begin(TICK_S)
        left_s = TICK_S
        while left_s > 0 and not (motion.at_rest and len(path) < 2):
            if motion.at_rest:
                motion.set_out(path[1])
            left_s = dynamics.advance("v", motion, path, left_s, PACE)
            if motion.cell != path[0]:
                del path[0]
        places.append(motion.place_m()[0])
    return places


def test_a_vehicle_speeds_up_tick_by_tick_however_many_stretches_a_tick_has() -> None:
    dynamics, _, asked = driven_by(lambda stretch: stretch.speed_m_per_s + 2.0 * stretch.tick_s)
    places = drive(dynamics, Motion(GRID, 0), list(range(30)), 40)
    assert places[-1] - 5.0 == pytest.approx(sum(0.2 * n * TICK_S for n in range(1, 41)))
    assert {stretch.tick_s for stretch in asked} == {TICK_S}
    assert asked[0].speed_m_per_s == 0.0
    assert asked[-1].speed_m_per_s == pytest.approx(0.2 * 39)


def test_a_vehicle_that_stood_for_a_tick_begins_from_rest() -> None:
    dynamics, _, asked = driven_by(lambda stretch: 10.0)
    motion = Motion(GRID, 0)
    drive(dynamics, motion, [0, 1], 20)
    drive(dynamics, motion, [1, 2], 1)
    assert asked[-1].speed_m_per_s == 0.0


def test_a_plugin_is_told_how_far_its_vehicle_may_drive_and_how_it_turns() -> None:
    square = GridSpec(5, 5, 10.0)
    dynamics, _, asked = driven_by(lambda stretch: 10.0)
    dynamics._grid = square
    path = [0, 1, 7, 12]
    drive(dynamics, Motion(square, 0), path, 60)
    assert asked[0].ahead_m == pytest.approx(10 + 10 * math.sqrt(2) + 10)
    assert asked[-1].ahead_m <= 5.0
    turns = [stretch.turn_rad for stretch in asked if stretch.turn_rad]
    assert turns == pytest.approx([math.pi / 4, math.pi / 4])
    assert all(stretch.limit_m_per_s == pytest.approx(10.0) for stretch in asked)


speeds = st.one_of(st.floats(), st.integers(), st.none(), st.booleans(), st.text(max_size=3))


@given(st.lists(speeds, min_size=1, max_size=40), st.integers(1, 6))
def test_whatever_is_said_no_vehicle_is_faster_than_the_ground_or_leaves_its_path(said, granted):
    answers = iter(said)
    dynamics, told, _ = driven_by(lambda stretch: next(answers))
    motion = Motion(GRID, 0)
    places = [5.0, *drive(dynamics, motion, list(range(granted)), len(said) + 20)]
    for before, after in pairwise(places):
        assert -1e-9 <= after - before <= TICK_S / PACE + 1e-9
    assert motion.cell < granted
    assert len(told) <= 1


# --- the dynamics of a class ------------------------------------------------------------------------------------

WIDE = GridSpec(12, 12, 10.0)


@settings(deadline=None, max_examples=60)
@given(
    st.lists(st.integers(0, 7), min_size=1, max_size=12),
    st.floats(0.2, 20.0),
    st.one_of(st.none(), st.floats(5.0, 720.0)),
    st.integers(1, 6),
)
def test_a_class_speeds_up_brakes_and_turns_no_quicker_than_it_can_and_arrives(steps, accel, turn_rate, granted):
    own = ClassConfig(name="truck", accel_m_per_s2=accel, turn_rate_deg_per_s=turn_rate)
    dynamics = own_dynamics(own, DynamicsWorld("a0", WIDE, 1))
    cells = [WIDE.cell(6, 6)]
    for step in steps:
        around = dict(WIDE.neighbours(cells[-1]))
        if step in around and around[step] not in cells:
            cells.append(around[step])
    motion, at, turned = Motion(WIDE, cells[0]), 0, 0.0
    speeds = [0.0]
    for _ in range(4000):
        path = cells[at : at + 1 + granted]
        if len(path) < 2:
            break
        dynamics.begin(TICK_S)
        left_s, seen = TICK_S, [0.0]
        while left_s > 0 and len(path) > 1:
            if motion.at_rest:
                motion.set_out(path[1])
            heading, before_m, before_s = motion.heading_rad, motion.done_m, left_s
            first_half, tail = motion.cell == motion.tail, motion.tail
            left_s = dynamics.advance("v", motion, path, left_s, PACE)
            seen.append(dynamics._are["v"][0])
            if first_half and turn_rate is not None and at and tail == cells[at]:
                turned = abs(math.remainder(heading - heading_of(cells[at - 1], cells[at]), math.tau))
                if turned > 1e-9 and before_m == 0.0 and before_s <= TICK_S:
                    assert seen[-1] <= math.radians(turn_rate) * WIDE.resolution_m / 2 / turned + 1e-9
            if motion.cell != path[0]:
                at += 1
                del path[0]
        speeds.append(seen[-1])
    assert at == len(cells) - 1, "it arrives"
    assert max((b - a for a, b in pairwise(speeds)), default=0.0) <= accel * TICK_S + 1e-9
    assert max(speeds) <= 1 / PACE + 1e-9


def heading_of(tail: int, head: int) -> float:
    south, east = head // WIDE.cols - tail // WIDE.cols, head % WIDE.cols - tail % WIDE.cols
    return math.atan2(east, -south) % math.tau


@pytest.mark.parametrize("accel", [0.5, 2.0, 50.0])
def test_a_class_brakes_to_a_stop_where_its_cells_end(accel: float) -> None:
    dynamics = own_dynamics(ClassConfig(name="truck", accel_m_per_s2=accel), DynamicsWorld("a0", GRID, 1))
    motion, path, speeds = Motion(GRID, 0), list(range(20)), [0.0]
    while len(path) > 1 or not motion.at_rest:
        drive(dynamics, motion, path, 1)
        speeds.append(dynamics._are["v"][0])
    changes = [after - before for before, after in pairwise(speeds)]
    assert max(changes) <= accel * TICK_S + 1e-9
    assert min(changes) >= -accel * TICK_S - 1e-6
    assert speeds[-1] <= accel * TICK_S + 1e-6, "what is left is lost within a tick"
    quickest = 2 * math.sqrt(190 / accel) if accel * 190 < 100 else 190 / 10 + 10 / accel
    assert TICK_S * len(speeds) <= 1.2 * quickest + 10 * TICK_S


def test_what_drives_as_the_ground_allows_has_no_dynamics() -> None:
    world = DynamicsWorld("a0", GRID, 1)
    named = NamedPlugin(PLUGIN_KINDS["dynamics"], "vehicles.dynamics", "ground", {})
    assert dynamics_of(Plugin(named, None, None), world, print) is None
    assert own_dynamics(None, world) is None
    assert own_dynamics(ClassConfig(name="walker", max_speed_m_per_s=2.0), world) is None
