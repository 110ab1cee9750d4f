"""The swarm that a command asks by default: the newest that runs here."""

import json
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
from support.command import Swarm

from launch_scripts.commands.run_commands import _chosen
from launch_scripts.commands.shared_options import Where, find_swarm
from launch_scripts.observe.run_folders import KnownRun, _started_s, begin_run, find_run, register, registered
from launch_scripts.ports import free_ports
from swarm.config.scenario import NetworkConfig, Scenario
from swarm.errors import BusError, ConfigError


@pytest.fixture
def listens() -> Iterator[list[int]]:
    """Ports that listen."""
    with socket.create_server(("127.0.0.1", 0)) as one, socket.create_server(("127.0.0.1", 0)) as other:
        yield [each.getsockname()[1] for each in (one, other)]


@pytest.fixture(autouse=True)
def _nobody_at_the_usual_endpoint(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("SWARM_STATE", str(tmp_path / "state"))
    (port,) = free_ports(1)

    class Usual(NetworkConfig, frozen=True, kw_only=True):
        connect: tuple[str, ...] = (f"tcp/127.0.0.1:{port}",)

    monkeypatch.setattr("swarm.config.scenario.NetworkConfig", Usual)


def make_run(runs: Path, name: str, port: int, *, namespace: str = "swarm", over: bool = False) -> None:
    folder = runs / name
    folder.mkdir(parents=True)
    endpoint = f"tcp/127.0.0.1:{port}"
    network = NetworkConfig(namespace=namespace, listen=(endpoint,), connect=(endpoint,))
    begin_run(folder, msgspec.structs.replace(Scenario(), network=network), name)
    if over:
        changed(runs, f"{name}.*.json", pid=NOBODY)


NOBODY = 2**30
"""The pid of no process."""


def changed(folder: Path, entries: str = "*", **fields: float) -> None:
    """Other values in entries of the registry."""
    for file in (folder / "state" / "runs").glob(entries):
        file.write_text(json.dumps(json.loads(file.read_text()) | fields))


def test_the_newest_run_whose_router_listens_is_found_whatever_its_port_and_namespace(
    tmp_path: Path, listens: list[int]
) -> None:
    (silent,) = free_ports(1)
    make_run(tmp_path, "old", listens[0])
    make_run(tmp_path, "mine", listens[1], namespace="north")
    make_run(tmp_path, "dead", silent)
    (run, network), (other, _) = find_swarm(tmp_path)
    assert (run, other) == ("mine", "old")
    assert (network.connect, network.namespace) == ((f"tcp/127.0.0.1:{listens[1]}",), "north")
    assert find_swarm(tmp_path, "old")[0][1].connect == (f"tcp/127.0.0.1:{listens[0]}",)
    assert find_swarm(tmp_path, str(tmp_path / "mine"))[0][0] == "mine"


def test_a_port_that_a_later_run_took_over_is_that_runs(
    tmp_path: Path, listens: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    make_run(tmp_path, "earlier", listens[0])
    make_run(tmp_path, "later", listens[0])
    make_run(tmp_path, "over", listens[1], over=True)
    assert [run for run, _ in find_swarm(tmp_path)] == ["later"], (
        "a stranger listens where the run that is over did"
    )
    monkeypatch.setattr(KnownRun, "processes", lambda run: {"router-0": 1} if run.name == "over" else {})
    assert [run for run, _ in find_swarm(tmp_path)] == ["later", "over"], (
        "its launcher was killed, its router lives"
    )


def test_what_was_looked_at_is_said_when_nothing_runs(tmp_path: Path) -> None:
    ports = free_ports(5)
    for n, port in enumerate(ports):
        make_run(tmp_path, f"r{n}", port)
    make_run(tmp_path, "simulated", ports[0])
    (tmp_path / "simulated" / "run.json").write_text('{"simulated": true}')
    with pytest.raises(BusError, match=r"no swarm runs here: .*usual endpoint"):
        find_swarm(tmp_path / "nowhere")
    with pytest.raises(BusError, match=rf"run r1 does not run here: no process listens \(tcp/.*:{ports[1]}\)"):
        find_swarm(tmp_path, "r1")


def test_options_say_more_than_the_run_does(tmp_path: Path, listens: list[int]) -> None:
    make_run(tmp_path, "mine", listens[0], namespace="north")
    assert Where(runs=tmp_path).network().namespace == "north"
    assert Where(runs=tmp_path, namespace="south").network().namespace == "south"
    assert str(Where(runs=tmp_path)) == f"in namespace 'north' at tcp/127.0.0.1:{listens[0]}"
    given = Where(connect="tcp/127.0.0.1:9", runs=tmp_path).network()
    assert (given.connect, given.namespace) == (("tcp/127.0.0.1:9",), "swarm")


def test_a_run_is_found_by_its_name_from_any_folder_until_its_folder_goes(
    tmp_path: Path, listens: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, port in zip(("first", "second"), listens, strict=True):
        make_run(tmp_path / name, name, port)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert [run.name for run in registered() if run.launchers] == ["second", "first"]
    assert find_run("first", Path("runs")) == tmp_path / "first" / "first"
    assert find_run("LAST", Path("runs")).name == "second"
    assert find_swarm(name="first")[0][1].connect == (f"tcp/127.0.0.1:{listens[0]}",)
    assert {run for run, _ in find_swarm()} == {"first", "second"}
    (tmp_path / "third" / "first").mkdir(parents=True)
    other = json.dumps({"folder": str(tmp_path / "third/first"), "pid": 9, "started_s": 0})
    (tmp_path / "state/runs/other.json").write_text(other)
    with pytest.raises(
        ConfigError, match=r"found 2 runs called 'first', expected the folder of one: /.*/third/first"
    ):
        find_run("first", Path("runs"))
    with pytest.raises(ConfigError, match=r"expected the name or folder of one: second, first$"):
        _chosen("LAST", only=True)  # here is no run of which that could be the newest
    assert [part.folder.parent.name for part in _chosen("first")] == ["first"], "its launcher runs"
    assert [part.folder.parent.name for part in _chosen(str(tmp_path / "third" / "first"))] == ["third"]
    (tmp_path / "third" / "first").rmdir()
    (tmp_path / "second").rename(tmp_path / "away")
    assert [run.name for run in registered()] == ["second", "first"], "the launcher of the second one runs"
    changed(tmp_path, pid=NOBODY)
    assert [run.name for run in registered()] == ["first"]
    assert len(list((tmp_path / "state" / "runs").iterdir())) == 1


def test_a_run_in_two_folders_is_one_run_by_its_name(
    tmp_path: Path, listens: list[int], monkeypatch: pytest.MonkeyPatch, swarm: Swarm
) -> None:
    for half, port in zip(("a", "b"), listens, strict=True):
        make_run(tmp_path / half, "halves", port)
        (tmp_path / half / "halves" / f"agent-{half}0.log").write_text(f"2026-01-01 00:00:00 from {half}\n")
    mine = {"folder": str(tmp_path / "a/halves"), "pid": os.getpid(), "started_s": _started_s(os.getpid())}
    (tmp_path / "state/runs/other.json").write_text(json.dumps(mine))
    for folder, path in ((tmp_path / "a", "../a/halves"), (tmp_path, "a/halves")):
        monkeypatch.chdir(folder)
        for name, halves in (("halves", {"a", "b"}), (None, {"a", "b"}), (path, {"a"})):
            assert {part.folder.parent.name for part in _chosen(name, only=True)} == halves
    told = swarm("logs --run halves")[1]
    assert ("from a" in told, "from b" in told) == (True, True)
    assert find_swarm(name="halves")[0][0] == "halves"
    (tmp_path / "b/halves/run.json").write_text('{"scenario": "another"}')
    with pytest.raises(ConfigError, match="found 2 runs called 'halves', expected the folder of one: /"):
        _chosen("halves")


@pytest.mark.parametrize("change", [{"pid": NOBODY}, {"started_s": 0.5}])
def test_a_launcher_that_has_ended_is_not_taken_for_the_process_which_has_its_pid_now(
    change: dict[str, float], tmp_path: Path
) -> None:
    make_run(tmp_path, "r", 9)
    changed(tmp_path, **change)
    assert [(run.name, run.launchers, run.processes()) for run in registered()] == [("r", (), {})]


@pytest.mark.parametrize("is_ours", [True, False])
def test_what_outlives_its_launcher_is_seen_and_ended(is_ours: bool, tmp_path: Path, swarm: Swarm) -> None:
    """It is stopped, so that it does not notice the end. A program of another kind is shown and left alone."""
    make_run(tmp_path, "r", 9)
    changed(tmp_path, pid=NOBODY)
    code = "import os; log = open('agent-a0.log', 'a'); log.write('last\\n'); log.flush(); os.kill(os.getpid(), 19)"
    words = [sys.executable, "-c", code, "swarm" if is_ours else "other"]
    with subprocess.Popen(words, cwd=tmp_path / "r", start_new_session=True) as left:
        try:
            os.waitpid(left.pid, os.WUNTRACED)
            (run,) = json.loads(swarm("ps --json")[1])
            told = swarm("down r")
            assert (run["state"], run["processes"]) == ("left over", 1)
            assert told[0] == (0 if is_ours else 2)
            assert ("killed: agent-a0" if is_ours else "r does not run in ") in told[1] + told[2]
            assert (left.wait(30) if is_ours else left.poll()) == (-9 if is_ours else None)
        finally:
            left.kill()
    assert json.loads(swarm("ps -a --json")[1])[0]["state"] == "broke off"


def test_a_stopped_launcher_is_shown_so(tmp_path: Path, swarm: Swarm) -> None:
    make_run(tmp_path, "r", 9)
    with subprocess.Popen([sys.executable, "-c", "import os; os.kill(os.getpid(), 19)"]) as stopped:
        try:
            os.waitpid(stopped.pid, os.WUNTRACED)
            changed(tmp_path, pid=stopped.pid, started_s=_started_s(stopped.pid))
            assert json.loads(swarm("ps --json")[1])[0]["state"] == "stopped"
        finally:
            stopped.kill()


@pytest.mark.parametrize(
    ("entry", "state"),
    [({}, "starting"), ({"is_whole": True}, "running"), ({"is_whole": True, "is_ending": True}, "ending")],
)
def test_a_run_that_ends_or_writes_its_report_is_shown_so(
    entry: dict[str, bool], state: str, tmp_path: Path, swarm: Swarm
) -> None:
    make_run(tmp_path, "r", 9)
    changed(tmp_path, **entry)
    assert json.loads(swarm("ps --json")[1])[0]["state"] == state


@pytest.mark.parametrize(
    "text",
    ["", "[[[", "[" * 100_000, "\xff", "5", "{}", '{"folder": "/", "pid": 0, "started_s": 0}',
     '{"folder": "/", "pid": -1, "started_s": 0}', '{"folder": ".", "pid": 9, "started_s": 0}'],
)  # fmt: skip
def test_a_damaged_entry_hides_no_run(text: str, tmp_path: Path) -> None:
    make_run(tmp_path, "r", 9)
    (tmp_path / "state" / "runs" / "damaged.json").write_text(text, encoding="latin-1")
    (tmp_path / "state" / "runs" / "folder.json").mkdir()
    (tmp_path / "state" / "runs" / "loop.json").symlink_to("loop.json")
    assert [run.name for run in registered()] == ["r"]


def test_a_registry_that_cannot_be_written_costs_a_sentence(tmp_path: Path, swarm: Swarm) -> None:
    (tmp_path / "state").write_text("a file takes the place of the folder")
    assert "cannot be registered: " in str(register(tmp_path))
    assert registered() == []
    code, _, said = swarm("up", "synthetic", "-d")
    assert code == 6
    assert said.startswith("swarm: --detach: the run could not be registered")
