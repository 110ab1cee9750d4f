"""Vehicles that are not in the scenario, in a swarm of real processes: one with a program of its own, and some that
`swarm order vehicle add` drives."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import pytest
from support.live_swarm import SWARM, LiveSwarm, ask, client, swarm
from support.processes import eventually

from swarm.bus.zenoh_bus import open_bus
from swarm.client import connect
from swarm.grid import GridSpec, walk
from swarm.right_of_way.external_session import ExternalSession
from swarm.right_of_way.generations import GenerationFile
from swarm.runtime.run_secret import authenticator_of
from swarm.wire.messages import Nothing
from swarm.wire.messages.planning import RouteRequest
from swarm.wire.messages.processes import RunInfo
from swarm.wire.route_columns import RouteStatus
from swarm.wire.topics import ROUTE, RUN

pytestmark = [pytest.mark.network, pytest.mark.slow]

OPTIONS = ("--no-live",)


@pytest.fixture(scope="module")
def run(live: LiveSwarm) -> RunInfo:
    with client(live.network) as bus:
        return next(info for info in ask(bus, RUN, Nothing()) if info.run_id)


def route_of(live: LiveSwarm, grid: GridSpec) -> list[int]:
    """The first cells of a route to a target."""
    with client(live.network) as bus:
        for n in range(10, 90, 7):
            (reply,) = ask(bus, ROUTE, RouteRequest(row=n, col=n, max_cells=12), target="t0")
            route = reply.routes[0]
            if route.status is RouteStatus.OK and len(route.directions) >= 12:
                return walk(grid, route.start, route.directions)
    raise AssertionError("no route of twelve cells from anywhere")


ROVER = """
import sys, time
from pathlib import Path
from swarm.client import connect

endpoint, file, *cells = sys.argv[1:]
path = [int(cell) for cell in cells]
with connect(endpoint) as swarm:
    rover = swarm.vehicle("rover", right_of_way=Path(file))
    for here, there in zip(path, path[1:]):
        rover.at(*swarm.frame.centre_m(here))
        rover.reserve(path[path.index(here) + 1:], timeout_s=20.0)
        assert rover.may_enter(there), there
    rover.at(*swarm.frame.centre_m(path[-1]))
    print("there", flush=True)
    time.sleep(60)
"""


def session_of(live: LiveSwarm, run: RunInfo, name: str, file: Path) -> ExternalSession:
    bus = open_bus(live.network, authenticator=authenticator_of(live.network, run.run_id))
    return ExternalSession(name, GridSpec(run.rows, run.cols, run.resolution_m), bus, GenerationFile(file))


def test_ones_own_program_drives_dies_comes_back_and_leaves(live: LiveSwarm, run: RunInfo, tmp_path: Path) -> None:
    path = route_of(live, GridSpec(run.rows, run.cols, run.resolution_m))
    command = [sys.executable, "-c", ROVER, live.endpoint, tmp_path / "rover", *path[:6]]
    program = subprocess.Popen(list(map(str, command)), stdout=subprocess.PIPE, text=True)
    assert program.stdout.readline() == "there\n"
    program.kill()
    program.wait(10)
    with session_of(live, run, "other", tmp_path / "other") as other:
        # The rover stands there, though its lease as an obstacle is over.
        assert not other.enter(path[5], timeout_s=4.0)
        with session_of(live, run, "rover", tmp_path / "rover") as rover:
            assert rover.enter(path[5], timeout_s=10.0)
            rover.want(path[5:])
            for here, there in pairwise(path[5:]):
                assert rover.may_enter(there, timeout_s=20.0), (rover.cells, there, rover.warnings)
                rover.left(here)
            assert other.may_enter(path[5], timeout_s=10.0)  # what it has asked for all the time
        assert other.leave(timeout_s=10.0)
        assert other.enter(path[-1], timeout_s=10.0)  # the rover has left
    with session_of(live, run, "third", tmp_path / "third") as third:
        assert third.enter(path[-1], timeout_s=10.0)


def vehicles_of(live: LiveSwarm, agent: str, count: int) -> set[str]:
    """The vehicles that an agent reports, once the number is reached."""
    with connect(live.endpoint) as joined, joined.observer() as seen:

        def reported() -> set[str]:
            return {id for id in list(seen.vehicles) if id.startswith(agent)}

        eventually(lambda: len(reported()) >= count, 20, f"{count} vehicles of {agent}")
        return reported()


def add(live: LiveSwarm, *options: object) -> subprocess.Popen[str]:
    command = [*SWARM, "order", "vehicle", "add", live.path, "--runs", live.runs, "--group", "all", *options]
    return subprocess.Popen(list(map(str, command)), stderr=subprocess.PIPE, text=True)


def test_vehicles_are_added_and_removed_while_the_swarm_runs(live: LiveSwarm, run: RunInfo) -> None:
    where = ("--connect", live.endpoint, "--namespace", live.network.namespace)
    added = add(live, "--count", 3, "--id", "extra")
    try:
        assert vehicles_of(live, "extra", count=3) == {"extra-00", "extra-01", "extra-02"}
        done = swarm("order", "vehicle", "remove", "extra-01", "a0-02", *where)
        assert (done.returncode, done.stderr) == (0, "")
        assert "extra-01: left" in done.stdout
        assert "a0-02: left" in done.stdout
        refused = swarm("order", "vehicle", "forget", "extra", *where)
        assert refused.returncode == 2
        assert "extra is alive" in refused.stderr
        assert swarm("order", "vehicle", "remove", "extra", *where).returncode == 0
        assert added.wait(60) == 0
    finally:
        added.kill()


def test_vehicles_of_a_killed_process_stay_until_it_is_back_or_a_person_says_that_they_are_gone(
    live: LiveSwarm, run: RunInfo
) -> None:
    where = ("--connect", live.endpoint, "--namespace", live.network.namespace)
    for again in range(2):
        added = add(live, "--count", 2, "--id", "more", "--at", "40,60")
        try:
            assert len(vehicles_of(live, "more", count=2)) == 2, again
        finally:
            added.send_signal(signal.SIGKILL)
            added.wait(10)
    time.sleep(live.network.lease_s + 0.5)
    gone = swarm("order", "vehicle", "forget", "more", *where)
    assert (gone.returncode, gone.stderr) == (0, ""), gone
    unknown = swarm("order", "vehicle", "forget", "nobody", *where)
    assert unknown.returncode == 2
    assert "no agent knows an external vehicle 'nobody'" in unknown.stderr
    for options, sentence in (
        (("--id", "x", "--group", "none"), "has no group 'none'"),
        (("--id", "a0"), "has an agent 'a0' itself"),
        (("--id", "x", "--at", "five"), "expected LAT,LON"),
        (("--id", "x", "--count", 99), "an agent hosts 1 to 6 vehicles"),
    ):
        refused = add(live, *options)
        assert refused.wait(60) == 2
        assert sentence in refused.stderr.read()


def test_nobody_has_met_anybody(live: LiveSwarm) -> None:
    live.end()
    report = json.loads((live.run_dir / "report.json").read_text())
    assert report["collisions"] == 0
