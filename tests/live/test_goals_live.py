"""A fleet of ten real vehicles with different goals: processes are killed, and all vehicles get there."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.live_swarm import SMALL_TERRAIN, LiveSwarm, running
from support.live_swarm import swarm as command
from support.processes import eventually

from swarm.client import connect

pytestmark = [pytest.mark.network, pytest.mark.slow]

FLEET = f"""
name = "fleet"
seed = 3
seconds = 3600
time_scale = 20
{SMALL_TERRAIN}
[[targets]]
walk = "still"

[[groups]]
vehicles = 10

[vehicles]
per_agent = 5

[planner]
places = true
"""


@pytest.fixture
def fleet(tmp_path: Path) -> Iterator[LiveSwarm]:
    with running(tmp_path, "--no-live", text=FLEET) as fleet:
        yield fleet


def test_ten_vehicles_get_to_ten_places_though_their_agent_and_the_planner_of_places_are_killed(
    fleet: LiveSwarm,
) -> None:
    with connect(fleet.endpoint) as swarm, swarm.observer() as seen:
        eventually(lambda: len(seen.vehicles) == 10, 60, "all vehicles")
        frame, orders = swarm.frame, swarm.orders()

        def cells() -> dict[str, int]:
            return {id: frame.cell(each.x_m, each.y_m) for id, each in seen.vehicles.items()}

        def cell(index: int) -> str:
            return "cell:{},{}".format(*frame.grid.row_col(index))

        assert orders.pause().silent == []
        eventually(lambda: cells() == (time.sleep(1.0) or cells()), 30, "a halt")  # type: ignore[func-returns-value]
        began = cells()
        ids = sorted(began)
        ends = ("--from", cell(began[ids[0]]), "--to", cell(began[ids[7]]))
        routed = command("route", *ends, "--connect", fleet.endpoint, "--json")
        assert routed.returncode == 0, routed.stderr
        found = json.loads(routed.stdout)
        assert found["routes"][0]["status"] == "ok"
        assert found["target_cell"] == began[ids[7]]
        same = swarm.route(*(frame.centre_m(began[id]) for id in (ids[0], ids[7])))
        assert (same.ok, same.cells[0], same.cells[-1]) == (True, began[ids[0]], began[ids[7]])
        assert same.cost_s >= same.lower_bound_s > 0.999 * same.cost_s
        rover = swarm.vehicle("r1")
        rover.at(*frame.centre_m(began[ids[0]]))
        routes = rover.follow(cell(began[ids[7]]))
        eventually(lambda: routes.newest is not None and routes.newest.cells == same.cells, 10, "a rover's route")
        rover.leave()
        # Each goes to where another one has been, so that there is a way.
        goals = {id: began[ids[(n + 7) % 10]] for n, id in enumerate(ids)}
        done = command("order", "vehicle", "send", ids[0], cell(goals[ids[0]]), "--connect", fleet.endpoint)
        assert done.returncode == 0, done.stderr
        assert "obeyed by 1 process," in done.stdout
        for id in ids[1:]:
            assert orders.send(id, [cell(goals[id])]).silent == []
        for name in ("agent-a0", "places-all"):
            os.kill(fleet.pid_of(name), signal.SIGKILL)
            eventually(lambda name=name: fleet.said(f"{name}: killed"), 20, "its end")  # type: ignore[misc]
        assert orders.resume().silent == []

        def all_there() -> bool:
            told = command("status", "--connect", fleet.endpoint, "--json")
            goals_now = json.loads(told.stdout)["goals"] if told.returncode == 0 else []  # while no process answers
            return len(goals_now) == 10 and all(each["state"] == "completed" for each in goals_now)

        eventually(all_there, 120, "all vehicles at their places")
        assert cells() == goals
        assert {each.target for each in seen.vehicles.values()} == {None}
        orders.recall(ids[3])
        eventually(lambda: seen.vehicles[ids[3]].target == "t", 20, "the chase of a vehicle that was recalled")
        assert len([each for each in orders.goals() if not each.off]) == 9
