"""Programs beside a swarm of real processes.

The scripts of the pages about vehicles and trackers of one's own run as they stand there; only the endpoint is
another, and the rover ten times as quick, as time in this swarm is. Vehicles with right of way follow. The tests
build on each other's order."""

import json
import os
import re
import signal
import struct
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import pytest
from support.live_swarm import SWARM, LiveSwarm
from support.live_swarm import swarm as command
from support.processes import eventually

from swarm.client import BusError, ConfigError, Swarm, SwarmError, connect
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


@pytest.mark.parametrize("name", ["vehicle.py", "reserving_vehicle.py", "target.py"])
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


def test_the_rover_of_the_page_enters_only_what_it_reserves(live: LiveSwarm) -> None:
    with connect(live.endpoint) as swarm, swarm.observer() as watching:
        swarm.orders().chase("all", ["t1"])  # a target that others catch would jump away from the rover
        run = Run((EXAMPLES / "reserving_vehicle.py").read_text(), live.endpoint)
        eventually(lambda: "rover" in watching.vehicles, 20, "the rover's first word")
        start = watching.vehicles["rover"].x_m, watching.vehicles["rover"].y_m
        eventually(
            lambda: (watching.vehicles["rover"].x_m, watching.vehicles["rover"].y_m) != start, 20, "its driving"
        )
        assert (run.end(within_s=90), run.process.returncode) == ("", 0)
        swarm.orders().chase("all", None)


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


def test_no_one_in_the_namespace_and_no_router_are_bus_errors(live: LiveSwarm) -> None:
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
    with swarm.observer() as watching, swarm.vehicle("guest", radius_m=3.0, right_of_way=file) as external:
        with connect(live.endpoint) as again, pytest.raises(SwarmError, match="in use"):
            again.vehicle("guest", right_of_way=file)
        external.at(*swarm.frame.centre_m(swarm.frame.grid.cell(40, 60)))
        cells = list(external.route("t0").cells)
        for here, there in pairwise(cells[:12]):
            reserved = external.reserve(cells[cells.index(here) + 1 :][:4], timeout_s=20.0)
            others = {id: swarm.frame.cell(each.x_m, each.y_m) for id, each in watching.vehicles.items()}
            assert there in reserved, f"not let into {there}: {problems}, {reserved}, others are in {others}"
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


# --- vehicles that are not in the scenario, which `swarm order vehicle add` drives ---


def vehicles_of(swarm: Swarm, agent: str, count: int) -> set[str]:
    """The vehicles that an agent reports, once the number is reached."""
    with swarm.observer() as seen:

        def reported() -> set[str]:
            return {id for id in list(seen.vehicles) if id.startswith(agent)}

        eventually(lambda: len(reported()) >= count, 20, f"{count} vehicles of {agent}")
        return reported()


def add(live: LiveSwarm, *options: object) -> subprocess.Popen[str]:
    words = [*SWARM, "order", "vehicle", "add", live.path, "--runs", live.runs, *options]
    words += [] if "--group" in options else ["--group", "all"]
    return subprocess.Popen(list(map(str, words)), stderr=subprocess.PIPE, text=True)


def test_vehicles_are_added_and_removed_while_the_swarm_runs(live: LiveSwarm, swarm: Swarm) -> None:
    where = ("--connect", live.endpoint)
    added = add(live, "--count", 3, "--id", "extra")
    try:
        assert vehicles_of(swarm, "extra", count=3) == {"extra-00", "extra-01", "extra-02"}
        done = command("order", "vehicle", "remove", "extra-01", "a0-02", *where)
        assert (done.returncode, done.stderr) == (0, "")
        assert "extra-01: left" in done.stdout
        assert "a0-02: left" in done.stdout
        refused = command("order", "vehicle", "forget", "extra", *where)
        assert refused.returncode == 2
        assert "extra is alive" in refused.stderr
        assert command("order", "vehicle", "remove", "extra", *where).returncode == 0
        assert added.wait(60) == 0
    finally:
        added.kill()


def test_vehicles_of_a_killed_process_stay_until_it_is_back_or_a_person_says_that_they_are_gone(
    live: LiveSwarm, swarm: Swarm
) -> None:
    where = ("--connect", live.endpoint)
    for again in range(2):
        added = add(live, "--count", 2, "--id", "more", "--at", "40,60")
        try:
            assert len(vehicles_of(swarm, "more", count=2)) == 2, again
        finally:
            added.send_signal(signal.SIGKILL)
            added.wait(10)
    time.sleep(live.network.lease_s + 0.5)
    gone = command("order", "vehicle", "forget", "more", *where)
    assert (gone.returncode, gone.stderr) == (0, ""), gone
    unknown = command("order", "vehicle", "forget", "nobody", *where)
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


def test_no_one_has_met_anybody(live: LiveSwarm) -> None:
    live.end()
    report = json.loads((live.run_dir / "report.json").read_text())
    assert report["collisions"] == 0
