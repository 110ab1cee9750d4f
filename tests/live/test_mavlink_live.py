"""`gateway mavlink` between a swarm of real processes and an autopilot that is not ours: MAVSDK's server side."""

import os
import re
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from rasterio.transform import from_origin
from support.height_models import written
from support.live_swarm import SWARM, LiveSwarm, running
from support.processes import Child, eventually

from launch_scripts.ports import free_ports
from swarm.client import Swarm, connect

pytest.importorskip("mavsdk", reason="mavsdk, an autopilot to speak to, is not installed")
pytest.importorskip("pymavlink", reason="pymavlink is not installed")
pytestmark = [pytest.mark.network, pytest.mark.slow]

VEHICLE = Path(__file__).parents[1] / "support" / "mavlink_vehicle.py"
ROWS, COLS, CELL_M = 60, 80, 30.0
TARGET, START = (12, 70), (40, 10)
_SCENARIO = """
name = "with-mavlink"
seconds = 3600

[terrain]
source = "ground.tif"
level_is = "ground"

[[targets]]
name = "t"
count = 1
walk = "still"
start = "cell:12,70"
caught = "stay"

[[groups]]
vehicles = 1

[planner]
places = true
"""


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveSwarm]:
    folder = tmp_path_factory.mktemp("mavlink")
    heights = np.add.outer(np.sin(np.arange(ROWS) / 5), np.cos(np.arange(COLS) / 7)).astype(np.float32) * 3 + 400
    place = from_origin(740_000, 4_030_000, CELL_M, CELL_M)
    written(folder / "ground.tif", heights, crs="EPSG:32616", transform=place)
    with running(folder, "--no-live", text=_SCENARIO) as live:
        yield live


class Pair:
    """A vehicle and its adapter, which may be started and killed one by one."""

    def __init__(self, folder: Path, live: LiveSwarm, swarm: Swarm) -> None:
        self.folder, self.live = folder, live
        self.port = free_ports(1)[0]
        frame = swarm.frame
        self.start = frame.to_wgs84(*frame.centre_m(frame.grid.cell(*START)))
        self.children: list[Child] = []

    def vehicle(self) -> Child:
        return self._start(sys.executable, VEHICLE, self.port, *self.start, 300)

    def adapter(self, *options: object) -> Child:
        where = ("--connect", self.live.endpoint, "--lost-after", 2)
        return self._start(*SWARM, "gateway", "mavlink", f"udpin:127.0.0.1:{self.port}", *where, *options)

    def _start(self, *command: object) -> Child:
        self.children.append(Child(self.folder / f"child{len(self.children)}.txt", *command))
        return self.children[-1]


@pytest.fixture
def pair(tmp_path: Path, live: LiveSwarm, swarm: Swarm) -> Iterator[Pair]:
    pair = Pair(tmp_path, live, swarm)
    yield pair
    for child in pair.children:
        child.kill()
        sys.stdout.write(f"--- {child.output.name}\n{child.text[-4000:]}\n")  # shown of a failure


def test_a_vehicle_of_mavlink_alone_is_avoided_and_gone_when_its_adapter_dies(pair: Pair, swarm: Swarm) -> None:
    with swarm.observer() as watching:
        pair.vehicle()
        adapter = pair.adapter("--id", "rover")
        eventually(lambda: "rover" in watching.vehicles, 60, "the rover in the swarm")
        seen = watching.vehicles["rover"]
        assert swarm.frame.cell(seen.x_m, seen.y_m) == swarm.frame.grid.cell(*START)
        assert "found an autopilot without modes" in adapter.text
        assert "mission" not in adapter.text, "nothing is driven without --target"
        adapter.process.send_signal(signal.SIGKILL)
        eventually(lambda: "rover" not in watching.vehicles, 5, "the end of the lease")


@pytest.mark.parametrize(("option", "named", "goal"), [("--target", "t", TARGET), ("--to", "cell:50,60", (50, 60))])
def test_without_arm_a_mission_is_uploaded_and_the_vehicle_stays_where_it_is(
    pair: Pair, swarm: Swarm, option: str, named: str, goal: tuple[int, int]
) -> None:
    vehicle = pair.vehicle()
    pair.adapter(option, named)
    vehicle.wait_for(r"^mission \d+ ")
    found = re.search(r"^mission (\d+) (\S+) (\S+)", vehicle.text, re.MULTILINE)
    end = swarm.frame.cell(*swarm.frame.from_wgs84(float(found[2]), float(found[3])))
    row, col = swarm.frame.grid.row_col(end)
    assert max(abs(row - goal[0]), abs(col - goal[1])) <= 1, "its last item is the cell of the target or place"
    assert int(found[1]) < 40, "turns, not cells"
    vehicle.wait_for(r"(?s)mission.*^at .*^at .*^at ")
    assert "armed" not in vehicle.text
    assert len(set(re.findall(r"^at (.*)$", vehicle.text, re.MULTILINE))) == 1


def test_with_arm_it_drives_to_the_target_and_goes_on_after_either_side_died(pair: Pair, swarm: Swarm) -> None:
    with swarm.observer() as watching:
        first = pair.vehicle()
        adapter = pair.adapter("--target", "t", "--arm", "--id", "rover")
        first.wait_for("^armed 1")
        x_m = swarm.frame.centre_m(swarm.frame.grid.cell(*START))[0]
        eventually(lambda: watching.vehicles["rover"].x_m > x_m + 100, 60, "its driving")
        first.kill()
        adapter.wait_for("no heartbeat for 2 s: the vehicle is left to its own fail-safe")
        second = pair.vehicle()
        second.wait_for(r"^mission \d+ ")
        adapter.wait_for("left alone from now on: it was disarmed, and not by us")
        assert "armed" not in second.text
        adapter.kill()
        pair.adapter("--target", "t", "--arm", "--id", "rover")
        second.wait_for("^armed 1")
        eventually(lambda: watching.vehicles["rover"].x_m > x_m + 100, 60, "its driving again")


def test_when_the_router_dies_the_vehicle_is_back_with_the_next_one(pair: Pair, live: LiveSwarm) -> None:
    pair.vehicle()
    adapter = pair.adapter("--target", "t", "--id", "rover")
    adapter.wait_for("the vehicle is in the swarm")
    first = live.pid_of("router-0")
    os.kill(first, signal.SIGKILL)
    eventually(lambda: live.pid_of("router-0") != first, 60, "another router")
    # One that is back within a second may not be missed at all.
    with connect(live.endpoint, timeout_s=60.0) as again, again.observer() as watching:
        eventually(lambda: "rover" in watching.vehicles, 60, "the rover after the router's death")
    adapter.process.send_signal(signal.SIGTERM)
    assert adapter.process.wait(60) == 0, "a signal ends it in order"
