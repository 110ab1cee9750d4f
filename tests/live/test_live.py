"""One small swarm of real processes, and all that may happen to it. The tests build on each other's order."""

import json
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from support.live_swarm import SWARM, LiveSwarm, ask, client, swarm
from support.processes import eventually, in_session

from launch_scripts.simulation.replay import replay_run
from swarm.bus.zenoh_bus import ZenohBus
from swarm.wire.messages import Nothing
from swarm.wire.messages.planning import RouteRequest
from swarm.wire.route_columns import RouteStatus
from swarm.wire.topics import ALIVE_KEY, ROUTE, RUN, TOPICS

pytestmark = [pytest.mark.network, pytest.mark.slow]

OPTIONS = ("--record-inputs",)


@pytest.fixture
def bus(live: LiveSwarm) -> Iterator[ZenohBus]:
    with client(live.network) as bus:
        yield bus


def served_cell(bus: ZenohBus, target: str = "t0") -> tuple[int, int]:
    """A cell from which there is a way to the target, by asking along the diagonal."""
    for n in range(4, 92, 4):
        (reply,) = ask(bus, ROUTE, RouteRequest(row=n, col=n), target=target)
        if reply.routes[0].status is RouteStatus.OK:
            return n, n
    raise AssertionError("no route from anywhere")


def incarnation(bus: ZenohBus, row: int, col: int) -> int | None:
    """Incarnation of the planner that serves a route now; None if none does."""
    for reply in ask(bus, ROUTE, RouteRequest(row=row, col=col), timeout_s=0.5, target="t0"):
        if reply.routes[0].status is RouteStatus.OK:
            return int(reply.incarnation)
    return None


def everybody(bus: ZenohBus) -> None:
    """Waits until all processes answer."""
    eventually(lambda: len(ask(bus, RUN, Nothing())) == 8, 10, "everybody's answer")


def test_a_person_asks_for_a_route_and_for_the_status(live: LiveSwarm, bus: ZenohBus) -> None:
    row, col = served_cell(bus)
    told = swarm("route", "--target", "t0", "--from", f"cell:{row},{col}", "--connect", live.endpoint)
    assert told.returncode == 0, told.stderr
    assert f"from cell:{row},{col} (xy:" in told.stdout
    told = swarm("route", "--target", "t0", "--from", f"cell:{row},{col}", "--connect", live.endpoint, "--json")
    assert json.loads(told.stdout)["routes"][0]["cells_row_col"][0] == [row, col]
    told = swarm("route", "--target", "t0", "--from", "cell:4000,1", "--connect", live.endpoint)
    assert (told.returncode, told.stdout) == (2, "")
    assert "--from is 'cell:4000,1', outside the terrain: 96 x 128 cells" in told.stderr
    told = swarm("route", "--target", "t7", "--from", f"cell:{row},{col}", "--connect", live.endpoint)
    assert (told.returncode, told.stdout) == (4, "")
    assert told.stderr.endswith("there are: 't0', 't1'\n")
    told = swarm("order", "vehicle", "send", "a0-01", "cell:5,5", "--connect", live.endpoint)
    assert (told.returncode, told.stderr.count("\n")) == (2, 1)
    assert "needs planner.places = true" in told.stderr
    status = json.loads(swarm("status", "--connect", live.endpoint, "--json").stdout)
    assert len(status["processes"]) == 8
    assert [planner["target"] for planner in status["planners"]] == ["t0", "t1"]
    assert "planner-t1" in swarm("status", "--runs", live.runs).stdout, "found by its folder"


def test_a_run_is_found_from_any_folder_with_its_page_logs_and_pids(live: LiveSwarm) -> None:
    (run,) = json.loads(swarm("ps", "--json").stdout)
    assert (run["folder"], run["state"], run["processes"]) == (str(live.run_dir), "running", 8)
    assert run["router"] == live.endpoint
    eventually(lambda: swarm("open", "--print").stdout.startswith("http://127.0.0.1:"), 30, "the live page")
    told = swarm("logs", "planner-t1", "-n", 2, "--run", run["run"])
    assert told.stdout == "".join((live.run_dir / "planner-t1.log").read_text().splitlines(True)[-2:])
    lines = [line.partition(" | ") for line in swarm("logs").stdout.splitlines()]
    assert {"launcher", "agent-a0", "router-0"} < {name.strip() for name, _, _ in lines}
    times = [text[:29] for _, _, text in lines if text.startswith("20")]
    assert times == sorted(times)
    status = json.loads(swarm("status", "--json").stdout)
    pids = {f"{each['role']}-{each['id']}": each["pid"] for each in status["processes"]}
    assert pids == {name: live.pid_of(name) for name in pids}
    titles = {name: psutil.Process(pid).cmdline()[0] for name, pid in pids.items()}
    assert "messages/s  restarts" in swarm("top", "--once", "--each").stdout, "a pipe has no width that cuts"
    assert titles["planner-t0"] == f"swarm: planner t0 (run {run['run']})"
    for name in ("launcher", "planner-t9", "1"):
        told = swarm("kill", name)
        assert (told.returncode, told.stderr.count("\n")) == (2, 1)
        said = f"has no process '{name}' on this machine", "t has 'agent-a0', 'agent-a1', "
        assert all(part in told.stderr for part in said), told.stderr


def test_a_second_run_in_the_background_is_ended_by_its_name(live: LiveSwarm, tmp_path: Path) -> None:
    first = live.run_dir.name
    smaller = tmp_path / "smaller.toml"
    smaller.write_text(
        live.path.read_text().replace("count = 2", "count = 1").replace("vehicles = 12", "vehicles = 1")
    )
    begun = swarm("up", smaller, "--port", 0, "--runs", tmp_path, "--no-live", "-d", timeout_s=90)
    (second,) = {each["run"] for each in json.loads(swarm("ps", "--json").stdout)} - {first}
    told = swarm("down")
    ended = swarm("down", second, timeout_s=90)
    assert begun.returncode == ended.returncode == 0, begun.stderr + ended.stderr
    assert begun.stderr.endswith(f"run {second} goes on in the background; `swarm down` ends it\n")
    found = f"swarm: found 2 runs here, expected the name or folder of one: {second}, {first}\n"
    assert (told.returncode, told.stderr) == (2, found)
    assert f"{tmp_path / second / 'report.html'}\n" in ended.stdout
    assert swarm("open", second, "--print").stdout == (tmp_path / second / "report.html").as_uri() + "\n"
    told = swarm("logs", "launcher", "--run", second, "-f")  # over, so it returns
    assert told.stdout == (tmp_path / second / "launcher.log").read_text()
    assert "stopping" in told.stdout
    states = {each["run"]: each["state"] for each in json.loads(swarm("ps", "-a", "--json").stdout)}
    assert (states[first], states[second]) == ("running", "ended")
    over = f"swarm: run {second} does not run in {tmp_path / second}; `swarm ps` lists those which do\n"
    assert swarm("down", second).stderr == over


def test_a_start_in_the_background_that_is_asked_to_end_leaves_no_run(live: LiveSwarm, tmp_path: Path) -> None:
    words = ("up", str(live.path), "--port", "0", "--runs", str(tmp_path), "--no-live", "-d")
    with subprocess.Popen([*SWARM, *words], stderr=subprocess.PIPE, text=True, start_new_session=True) as start:
        assert start.stderr.readline(), "the launcher has said something"
        start.send_signal(signal.SIGTERM)
        assert "goes on in the background" not in start.communicate(timeout=60)[1]
    assert [run["run"] for run in json.loads(swarm("ps", "--json").stdout)] == [live.run_dir.name]


def test_top_tells_what_every_process_takes_up(live: LiveSwarm) -> None:
    def told_of_all() -> bool:
        """False while a process has not spoken twice, as on a machine that is busy."""
        top = json.loads(swarm("top", "--runs", live.runs, "--json", "--once").stdout)
        each = top["processes"]  # router and monitor tell theirs, too
        told = len(each) == 8 and None not in [one["cpu_percent"] for one in each]
        return told and top["processes_well"] == [6, 6] and all(one["rss_bytes"] > 10e6 for one in each)

    eventually(told_of_all, 30, "figures of all processes")


def test_garbage_on_every_key_is_counted_and_dropped(live: LiveSwarm, bus: ZenohBus) -> None:
    garbage = (b"", b"\xc1", b"\x00" * 4000, b"\xff" * 17, b"\x80", b'{"schema": "run/1"}', b"\xdd\xff\xff\xff\xff")
    fields = {name: "0" for topic in TOPICS for name in topic.fields} | {"target": "t0", "agent": "a0"}
    for topic in TOPICS:
        key = topic.keyed("swarm", **{name: fields[name] for name in topic.fields})
        for payload in garbage:
            bus.session.put(key, payload)
            if topic.request is not None:
                list(bus.session.get(topic.expression("swarm"), payload=payload, timeout=1.0))
    bus.session.put(f"swarm/{ALIVE_KEY.format(role='agent', id='a0', incarnation='soon')}", b"")
    token = bus.session.liveliness().declare_token("swarm/alive/agent/a9/yesterday")
    time.sleep(2.5)
    token.undeclare()

    def all_have_dropped() -> bool:
        """False while one has not told its counts, as on a machine that is busy."""
        each = json.loads(swarm("status", "--connect", live.endpoint, "--json").stdout)["processes"]
        return len(each) == 8 and all(one["counts"]["payloads_dropped"] > 0 for one in each)

    eventually(all_have_dropped, 20, "a payload that each process has dropped")
    assert live.said("restarts 0")
    assert not live.said("starts again")


def test_a_second_swarm_in_the_namespace_is_refused_and_the_first_goes_on(live: LiveSwarm, tmp_path: Path) -> None:
    told = swarm("up", live.path, "--connect", live.endpoint, "--runs", tmp_path, "--plain")
    assert told.returncode == 5, told.stdout + told.stderr
    assert "belongs to run" in told.stderr
    assert told.stderr.count("\n") == 1
    assert not live.said("starts again")


def test_a_planner_killed_with_9_serves_routes_again_within_3_s(live: LiveSwarm, bus: ZenohBus) -> None:
    row, col = served_cell(bus)
    before = incarnation(bus, row, col)
    assert swarm("kill", "planner-t0").returncode == 0
    began_s = time.monotonic()
    eventually(lambda: incarnation(bus, row, col) not in (None, before), 10, "a route from the new planner")
    assert time.monotonic() - began_s <= 3.0
    eventually(lambda: live.said("planner-t0: killed by SIGKILL; starts again in 0.2 s"), 5)


def test_a_router_killed_with_9_comes_back_and_the_swarm_goes_on(live: LiveSwarm, bus: ZenohBus) -> None:
    row, col = served_cell(bus)
    os.kill(live.pid_of("router-0"), signal.SIGKILL)
    eventually(lambda: live.said("router-0: killed by SIGKILL"), 5)
    eventually(lambda: incarnation(bus, row, col), 10, "a route through the new router")
    everybody(bus)


def test_an_agent_killed_with_9_goes_on_with_its_vehicles(live: LiveSwarm, bus: ZenohBus) -> None:
    os.kill(live.pid_of("agent-a0"), signal.SIGKILL)
    eventually(lambda: live.said("agent-a0: killed by SIGKILL"), 5)
    everybody(bus)


def test_a_ctrl_c_ends_all_in_order_and_leaves_the_report(live: LiveSwarm) -> None:
    time.sleep(3.0)
    assert live.end() == 0, live.output.read_text()
    assert "KeyboardInterrupt" not in (live.run_dir / "planner-t1.log").read_text()
    report = json.loads((live.run_dir / "report.json").read_text())
    assert report["restarts"] == 3
    assert report["startup_s"] > 0
    assert (report["collisions"], report["lethal_entries"]) == (0, 0)
    assert report["vehicles_routed"] == 12
    assert report["payloads_dropped"] > 0
    for name in ("report.png", "run.rrd", "router-0.log", "planner-t1.log", "launcher.log"):
        assert (live.run_dir / name).stat().st_size > 0
    eventually(lambda: not in_session(live.process.pid), 5, "the end of all")


def test_each_process_of_it_gives_the_same_when_its_inputs_are_replayed(live: LiveSwarm) -> None:
    replayed = list(replay_run(live.run_dir))
    assert {(each.recorded.process, each.recorded.generation) for each in replayed} >= {
        *(("planner-t0", 2), ("planner-t1", 1), ("agent-a0", 2), ("agent-a1", 1)),
        *(("keeper-0", 1), ("targets-0", 1)),
    }
    for each in replayed:
        assert each.same, each
