"""A run outlives its processes: all may be started again, and the acknowledged state is there."""

import json
import os
import signal
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
from support.live_swarm import running, swarm
from support.processes import eventually, in_session

from launch_scripts.launcher.run_options import find_scenario

pytestmark = pytest.mark.network


def sets_in(store: Path) -> int:
    done = swarm("marks", "show", store, "--json")
    assert done.returncode == 0, done.stderr
    return int(json.loads(done.stdout)["sets"])


@pytest.mark.parametrize(
    "kill", [os.kill, pytest.param(os.killpg, marks=pytest.mark.thorough)], ids=["launcher", "all"]
)
def test_a_launcher_that_is_killed_and_started_again_with_its_run_id_goes_on_with_the_keepers_store(
    tmp_path: Path, kill: Callable[[int, int], None]
) -> None:
    words = ("--run-id", "again", "--no-live")
    with running(tmp_path, *words) as first:
        store = tmp_path / "runs" / "again" / "map.sqlite"
        eventually(lambda: store.exists() and sets_in(store) > 0, 60, "marks in the store")
        os.kill(first.pid_of("planner-t0"), signal.SIGSTOP)  # which notices nothing
        kill(first.process.pid, signal.SIGKILL)  # with it or after it all that it started ends
        first.process.wait(10)
        eventually(lambda: not in_session(first.process.pid), 10, "the end of all")
        before = sets_in(store)
    with running(tmp_path, *words):
        assert sets_in(store) >= before


def test_parts_of_a_swarm_that_are_started_on_several_machines_belong_to_one_run_in_any_order() -> None:
    from launch_scripts.launcher.run_options import common_run_id, with_port

    scenario = find_scenario("synthetic")
    longer = msgspec.structs.replace(scenario, seconds=scenario.seconds + 60)
    assert common_run_id(with_port(scenario, 4711)) == common_run_id(longer) == common_run_id(scenario)
    assert common_run_id(find_scenario("jacksboro")) != common_run_id(scenario)
