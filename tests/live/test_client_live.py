"""The scripts of the pages about vehicles and trackers of one's own, run as they stand there against real
processes. Only the endpoint is another, and the rover ten times as quick, as time in this swarm is."""

from __future__ import annotations

import os
import re
import struct
import subprocess
import sys
import threading
import time
from itertools import pairwise
from pathlib import Path

import pytest
from support.live_swarm import LiveSwarm
from support.live_swarm import swarm as command
from support.processes import eventually

from swarm.client import BusError, ConfigError, Route, Swarm, SwarmError, connect
from swarm.clock import NS_PER_S
from swarm.runtime.tracker_ownership import SAME_NS

pytestmark = [pytest.mark.network, pytest.mark.slow]

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "docs" / "examples"
OPTIONS = ("--no-live",)
ALSO = '\n[[targets]]\nname = "fox"\nwalk = "external"\n'
RUST = os.environ.get("RUST_VEHICLE", "")


class Run:
    """A script under way."""

    def __init__(self, text: str, endpoint: str, *arguments: object) -> None:
        text = text.replace("tcp/127.0.0.1:7447", endpoint)
        self.process = subprocess.Popen(
            [sys.executable, "-c", text, *map(str, arguments)], stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, text=True,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )  # fmt: skip

    def end(self, within_s: float) -> str:
        try:
            return self.process.communicate(timeout=within_s)[0]
        finally:
            self.process.kill()


@pytest.mark.parametrize("name", ["vehicle.py", "target.py"])
def test_a_complete_program_has_twenty_lines_at_most(name: str) -> None:
    assert len([line for line in (EXAMPLES / name).read_text().splitlines() if line.strip()]) <= 20


def test_a_program_that_ends_unclosed_ends_well_and_its_vehicle_leaves(live: LiveSwarm, swarm: Swarm) -> None:
    text = """
from swarm.client import connect
swarm = connect("tcp/127.0.0.1:7447")
rover = swarm.vehicle("short", lease_s=10.0)
rover.at(*swarm.frame.centre_m(0))
rover.route("t0", timeout_s=20.0)
"""
    with swarm.observer() as watching:
        run = Run(text, live.endpoint)
        assert (run.end(within_s=40), run.process.returncode) == ("", 0)
        eventually(lambda: "short" not in watching.vehicles, 3, "the vehicle's leaving")


def test_the_rover_of_the_page_joins_drives_to_its_target_marks_and_leaves(live: LiveSwarm, swarm: Swarm) -> None:
    with swarm.observer() as watching:
        run = Run((EXAMPLES / "vehicle.py").read_text(), live.endpoint)
        eventually(lambda: "rover" in watching.vehicles, 20, "the rover's first word")
        first = watching.vehicles["rover"]
        # On a busy machine an answer may be late: that is said, and asked again.
        lines = run.end(within_s=60).splitlines()
        assert all(re.search(r"^ok: \d+ s to drive$|gets no route to t0", line) for line in lines), lines
        assert run.process.returncode == 0
        eventually(lambda: "rover" not in watching.vehicles, 3, "the rover's leaving")
        # The author's statement, not the winner: vehicles that see the same ground may state otherwise at once.
        eventually(lambda: any(".rover." in author for _, author in watching._sets), 10, "its marks")
        said = next(each for (_, author), each in watching._sets.items() if ".rover." in author)
        assert set(struct.unpack(f"<{len(said.paces) // 4}f", said.paces)) == {0.5}
        assert (first.state, first.group) == ("outside", "all")


def test_the_tracker_of_the_page_moves_its_target_and_the_planner_follows(live: LiveSwarm, swarm: Swarm) -> None:
    with swarm.observer() as watching, swarm.vehicle("asker") as asker:
        asker.at(*swarm.frame.centre_m(swarm.frame.grid.cell(40, 60)))
        assert asker.route("fox").status == "no_target"
        run = Run((EXAMPLES / "target.py").read_text(), live.endpoint)
        eventually(lambda: asker.route("fox").ok, 20, "a route to the fox")
        place = watching.targets["fox"]
        eventually(lambda: watching.targets["fox"].x_m != place.x_m, 10, "its moving")
        assert run.end(within_s=40) == ""


def test_a_tracker_with_zenoh_alone_owns_its_target_until_it_is_dead(live: LiveSwarm, swarm: Swarm) -> None:
    place = swarm.frame.centre_m(swarm.frame.grid.cell(50, 60))
    said = ("fox", "radar", *place), ("fox", "camera", place[0], place[1] + 300)
    text = (EXAMPLES / "tracker.py").read_text()
    route = ("route", "--target", "fox", "--from", "cell:40,40", "--connect", live.endpoint)
    with swarm.observer() as watching:
        first = Run(text, live.endpoint, live.endpoint, *said[0])
        eventually(lambda: (fox := watching.targets.get("fox")) and fox.tracker == "radar", 20, "the first tracker")
        time.sleep(SAME_NS / NS_PER_S)  # trackers which begin together are told apart by their names
        second = Run(text, live.endpoint, live.endpoint, *said[1])
        eventually(lambda: live.said("poses of tracker camera are refused, as tracker radar owns it"), 20, "a note")
        assert (watching.targets["fox"].x_m, watching.targets["fox"].y_m) == place
        first.process.kill()
        eventually(lambda: watching.targets["fox"].tracker == "camera", 20, "the second tracker")
        second.process.kill()
        eventually(lambda: watching.targets["fox"].lost, 20, "the loss")
    lost = "fox is lost: it has no tracker, and this is its position"
    eventually(lambda: lost in command(*route).stdout, 20, "that the planner says so")


def test_a_live_vehicle_hears_routes_by_callbacks_and_streams_and_what_is_wrong_in_sentences(swarm: Swarm) -> None:
    told: list[Route] = []
    with swarm.vehicle("caller", radius_m=3.0) as caller:
        with pytest.raises(ConfigError, match="outside the terrain"):
            caller.at(-1e6, 0.0)
        caller.at(*swarm.frame.centre_m(swarm.frame.grid.cell(40, 60)))
        caller.on_route(told.append)
        routes = caller.follow("t1")
        eventually(lambda: len(told) >= 3, 20, "routes to a target that moves")
        assert routes.next(1.0) is told[0]
        with pytest.raises(BusError, match="no route to 'nobody'"):
            caller.route("nobody", timeout_s=0.5)
        assert swarm.counts["refused"] == 1
        ended = threading.Event()
        reader = threading.Thread(target=lambda: ([None for _ in routes], ended.set()), daemon=True)
        reader.start()
    assert ended.wait(2.0), "leaving ends the stream"


def test_nobody_in_the_namespace_and_no_router_are_bus_errors(live: LiveSwarm) -> None:
    with pytest.raises(BusError, match="no process of a swarm answers in namespace 'nobody' at tcp/"):
        connect(live.endpoint, namespace="nobody", timeout_s=1.0)
    with pytest.raises(BusError, match=r"cannot reach a router at tcp/127\.0\.0\.1:1:"):
        connect("tcp/127.0.0.1:1", timeout_s=1.0)
    with pytest.raises(ConfigError, match="leaves this machine in the clear"):
        connect("tcp/10.0.0.1:7447")


@pytest.mark.skipif(
    not RUST, reason="RUST_VEHICLE names no built docs/examples/rust_vehicle; a build takes minutes"
)
def test_a_vehicle_in_rust_asks_and_puts_json(live: LiveSwarm, swarm: Swarm) -> None:
    with swarm.observer() as watching:
        run = subprocess.Popen([RUST, live.endpoint], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        eventually(lambda: "rusty" in watching.vehicles, 20, "the vehicle in Rust")
        assert watching.vehicles["rusty"].x_m == 1805.0
        said, _ = run.communicate(timeout=30)
        assert re.fullmatch(r"[0-9.]+ s to t0\n", said), said


def test_a_vehicle_with_right_of_way_reserves_its_way_and_is_let_in_cell_by_cell(
    live: LiveSwarm, swarm: Swarm, tmp_path: Path
) -> None:
    file = tmp_path / "guest.lives"
    problems: list[str] = []
    swarm.on_problem(problems.append)
    with swarm.vehicle("guest", radius_m=3.0, right_of_way=file) as external:
        with connect(live.endpoint) as again, pytest.raises(SwarmError, match="in use"):
            again.vehicle("guest", right_of_way=file)
        external.at(*swarm.frame.centre_m(swarm.frame.grid.cell(40, 60)))
        cells = list(external.route("t0").cells)
        for here, there in pairwise(cells[:12]):
            reserved = external.reserve(cells[cells.index(here) + 1 :][:4], timeout_s=20.0)
            assert there in reserved, f"not let into {there}: {problems}"
            assert external.may_enter(there)
            external.at(*swarm.frame.centre_m(there))
        assert not external.may_enter(cells[0]), "it has been given back"
        with pytest.raises(ConfigError, match="vehicle guest: cell 0 of the path is not next to cell"):
            external.reserve([0])
        external.at(*swarm.frame.centre_m(swarm.frame.grid.cell(2, 2)))
        eventually(lambda: problems, 2, "a word about driving where it was not let in")
    assert problems == [f"vehicle guest is in cell {swarm.frame.grid.cell(2, 2)}, into which it was not let: stop"]
    with swarm.vehicle("other") as other:
        other.at(*swarm.frame.centre_m(5))
        with pytest.raises(ConfigError, match="has no right of way: make it with"):
            other.may_enter(5)


def test_orders_of_a_program_are_obeyed_and_taken_back(swarm: Swarm) -> None:
    orders = swarm.orders()
    assert not orders.pause().silent
    assert [order.subject for order in orders.given()] == ["pause"]
    assert not orders.resume().silent
    x_m, y_m = swarm.frame.centre_m(swarm.frame.grid.cell(80, 110))
    corners = [(x_m, y_m), (x_m + 90, y_m), (x_m + 90, y_m - 90), (x_m, y_m - 90)]
    name, acknowledged = orders.add_zone(corners, name="works", for_s=600.0)
    assert (name, acknowledged.silent) == ("works", [])
    with swarm.observer() as watching:
        eventually(lambda: sum(mark.lethal for mark in watching.marks.values()) >= 4, 5, "the zone in the map")
    assert [zone.name for zone in orders.zones()] == ["works"]
    assert not orders.remove_zone("works").silent
    with pytest.raises(ConfigError, match="the order is not possible"):
        orders.add_zone(corners[:2])
