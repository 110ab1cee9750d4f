"""Agents end to end on a simulated network: they follow, find out, mark, make way, and come back from the dead."""

from __future__ import annotations

from swarm.messages import VehicleState
from agent_world import AgentWorld, pace_of

SCENARIO = """
name = "test"
seed = 3
[[targets]]
name = "t"
walk = "still"
[[groups]]
vehicles = {vehicles}
cells = {cells}
[vehicles]
per_agent = {per_agent}
sense_range_m = 30.0
capture_range_m = {capture}
"""


def scenario(
    vehicles: int, cells: list[tuple[int, int]] | None = None, per_agent: int = 2, capture: float = 10.0
) -> str:
    given = [list(cell) for cell in cells or []]
    return SCENARIO.format(vehicles=vehicles, cells=given, per_agent=per_agent, capture=capture)


OPEN = ["." * 20] * 20


def test_vehicles_drive_to_the_target_and_arrive_as_soon_as_the_pace_allows() -> None:
    world = AgentWorld(scenario(1, [(10, 2)]), pace_of(OPEN))
    world.put_target("t", 10, 12)
    world.start_all()
    took_s = world.until(lambda: world.all_in(VehicleState.ARRIVED), within_s=30)
    # 9 cells of 10 m at 0.1 s/m to come within 10 m of the target, and at most a second to get going.
    assert 8.5 <= took_s <= 10.5
    assert world.where() == {"a0-00": (10, 11)}
    world.assert_lawful()


def test_four_agents_share_the_ground_without_meeting() -> None:
    world = AgentWorld(scenario(8, capture=15.0), pace_of(OPEN))
    world.put_target("t", 10, 10)
    world.start_all()
    world.until(lambda: world.all_in(VehicleState.ARRIVED), within_s=60)
    world.assert_lawful()
