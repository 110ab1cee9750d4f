"""Three machines, as docs/operate/machines.md says word by word, and the loss of one of them for good.

Figures for a number of losses: `PYTHONPATH=.:tests python tests/live/test_deploy_plan.py 3`"""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import sqlite3
import subprocess
import sys
import tarfile
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from bench.wire.partition import partitions
from support import onlooker_program
from support.live_swarm import SMALL_WORLD
from support.machines import Machines, machines, why_not
from support.onlooker_program import steady
from support.processes import eventually

from swarm.peers import split_rank

pytestmark = [pytest.mark.network, pytest.mark.slow]

PAGE = Path(__file__).parents[2] / "docs" / "operate" / "machines.md"
COMMANDS_AT_MOST = 6
LOST = "alpha"
LOOKS_FROM, THROUGH = "desk", "bravo"
LONGEST_S = 60.0
"""Beside other tests on two cores."""
ENDS_S = 600.0
ADDRESSES = {"alpha": "10.77.0.1", "bravo": "10.77.0.2", "charlie": "10.77.0.3", LOOKS_FROM: "10.77.0.9"}
PER_AGENT = 2
SCENARIO = f"""
name = "small"
seed = 3
time_scale = 4
{SMALL_WORLD}
[vehicles]
per_agent = {PER_AGENT}
"""


def block(heading: str, number: int = 0) -> list[str]:
    """The lines of a block of code below a heading of the page."""
    _, _, text = PAGE.read_text(encoding="utf-8").partition(f"\n## {heading}\n")
    blocks = re.findall(r"(?:^    .*\n(?:\n(?=    ))?)+", text.partition("\n## ")[0], re.MULTILINE)
    return [line[4:] for line in blocks[number].splitlines()]


def program(path: Path, text: str) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)


class Deployed:
    """The page followed on three machines: its file of machines, its commands, in a shell of its own."""

    def __init__(self, folder: Path, network: Machines) -> None:
        self.folder, self.network = folder, network
        self.kits = folder / "kits"
        run_swarm = "import sys; from launch_scripts.cli import main; sys.exit(main())"
        program(folder / "bin" / "swarm", f"exec {sys.executable} -c '{run_swarm}' \"$@\"")
        cases = "".join(
            f"{address}) space={network.space(name)} place={folder / name};;\n"
            for name, address in network.addresses.items()
        )
        program(
            folder / "bin" / "ssh",
            f'case "$1" in\n{cases}esac\nmkdir -p "$place"; cd "$place"; exec ip netns exec "$space" sh -c "$2"',
        )
        (folder / "my.toml").write_text(SCENARIO)
        (folder / "hosts.toml").write_text("\n".join(block("Steps", 0)))

    def follow(self, commands: list[str]) -> None:
        """Runs the commands of the page: those of `ssh` side by side, as they last as long as the swarm."""
        for line in commands:
            if line.startswith("ssh "):
                name = next(name for name, address in self.network.addresses.items() if f" {address} " in line)
                log = (self.folder / f"{name}.log").open("ab")
                with log:
                    self.network.keep(
                        name,
                        subprocess.Popen(
                            ["sh", "-c", line], cwd=self.folder, env=self.network.environment, text=True,
                            stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True,
                        ),
                    )  # fmt: skip
            else:
                subprocess.run(
                    ["sh", "-c", line], cwd=self.folder, env=self.network.environment, check=True, timeout=120
                )

    def store(self, machine: str) -> Path:
        (path,) = {path.resolve() for path in (self.folder / machine).glob("swarm-*/runs/*/map*.sqlite")}
        return path

    def logs(self) -> str:
        return "\n".join(f"{path.name}:\n{path.read_text()[-3000:]}" for path in self.folder.glob("*.log"))


class Onlooker:
    """A program on a machine of its own that notes what the swarm says of itself: `onlooker_program`, line by line.
    `notes` holds its latest values; see `onlooker_program.Notes`."""

    def __init__(self, machines: Machines, name: str, scenario: Path, endpoint: str, certificates: Path) -> None:
        command = [sys.executable, str(onlooker_program.__file__), str(scenario), endpoint, str(certificates)]
        self.notes: dict[str, Any] = {}
        self._process = machines.start(name, [*command, str(ENDS_S)], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self.notes = json.loads(line)

    def close(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            self._process.wait(20)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait(20)
        self._reader.join(20)


@contextmanager
def deployed(folder: Path) -> Iterator[tuple[Deployed, Onlooker]]:
    environment = {
        **os.environ,
        "PATH": f"{folder / 'bin'}:{os.environ['PATH']}",
        "PYTHONPATH": f"{PAGE.parents[1]}:{PAGE.parents[1] / 'tests'}",
    }
    with machines(ADDRESSES, environment) as network:
        made = Deployed(folder, network)
        made.follow([*block("Steps", 1), *block("Without systemd", 0)])
        scenario = folder / "my.toml"
        endpoint = f"tls/{ADDRESSES[THROUGH]}:7447"
        onlooker = Onlooker(network, LOOKS_FROM, scenario, endpoint, made.kits / "certs")
        try:
            yield made, onlooker
        finally:
            onlooker.close()


class Machine:
    """One of the plan that the page's commands made."""

    def __init__(self, made: Deployed, name: str) -> None:
        with tarfile.open(made.kits / f"{name}.tar.gz") as archive:
            file = archive.extractfile(f"swarm-{name}/plan.json")
            assert file is not None
            plan = json.load(file)
        (host,) = (host for host in plan["hosts"] if host["name"] == name)
        self.ids: dict[str, list[str]] = {}
        for process in host["processes"]:
            self.ids.setdefault(process["role"], []).append(process["id"])
        self.leads = [id for id in self.ids["planner"] if split_rank(id)[1] == 0]
        self.vehicles = {f"{agent}-{n:02d}" for agent in self.ids["agent"] for n in range(PER_AGENT)}


def lose_one(made: Deployed, onlooker: Onlooker) -> dict[str, float]:
    """Takes a machine away, and returns what that cost the others, in seconds; fails where it is too much."""
    gone, *others = (Machine(made, name) for name in (LOST, THROUGH, "charlie"))
    left = set().union(*(machine.vehicles for machine in others))
    assert gone.leads, "a machine whose loss takes away planners that lead"

    def settled() -> bool:
        notes = onlooker.notes
        return bool(
            notes
            and set(notes["routed"]) == left | gone.vehicles
            and set(notes["answered"]) == {"t0", "t1"}
            and all(steady(notes["leads"], planner) for planner in gone.leads)
            and set(gone.leads) <= {notes["targets"].get(vehicle) for vehicle in left}
            and len(notes["acknowledged"].get(gone.ids["keeper"][0], ())) > 5
        )

    within(240, settled, made, "a whole swarm")
    lost_s, before = time.monotonic(), onlooker.notes
    made.network.lose(LOST)
    orphans = {vehicle: before["targets"][vehicle] for vehicle in left if before["targets"][vehicle] in gone.leads}
    acknowledged = before["acknowledged"][gone.ids["keeper"][0]]

    # The planner that answered last has ended; its standby may have led before, too.
    dead = {
        target: max(before["answered"][target].items(), key=lambda generation: generation[1][1])[0]
        for target in gone.leads
    }

    def answers(target: str) -> list[float]:
        """Time of the first answer after the loss by another planner than the dead one."""
        found = onlooker.notes["answered"][target]
        return [first for generation, (first, _) in found.items() if generation != dead[target] and first > lost_s]

    def first_routes() -> list[float]:
        """For each vehicle whose planner has ended: the time at which another planner pushed a route, or the
        vehicle began one, perhaps of another target."""
        notes = onlooker.notes
        return [
            min(
                *(
                    at_s
                    for at_s, generation in notes["pushed"].get(vehicle, ())
                    if at_s > lost_s and str(generation) != dead[target]
                ),
                *(at_s for at_s in notes["followed"].get(vehicle, ()) if at_s > lost_s),
                math.inf,
                math.inf,
            )
            for vehicle, target in orphans.items()
        ]

    def routed_again() -> bool:
        routed = onlooker.notes["routed"]
        return (
            max(first_routes()) < math.inf
            and all(answers(target) for target in gone.leads)
            and all(routed[vehicle] > lost_s + 1 for vehicle in left)
        )

    within(LONGEST_S, routed_again, made, "routes for all vehicles that are left")
    answered = onlooker.notes["answered"]
    silent_s = [min(answers(target)) - answered[target][dead[target]][1] for target in gone.leads]
    within(LONGEST_S, lambda: not lacking(acknowledged, made.store(THROUGH)), made, "every acknowledged mark")
    return {
        "until the last vehicle got a route": max(first_routes()) - lost_s,
        "without an answer to a client": max(silent_s),
    }


def lacking(acknowledged: dict[str, list[int]], path: Path) -> set[str]:
    """Sets that were acknowledged and that a store has neither as they were nor newer."""
    with contextlib.closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as store:
        rows = store.execute("SELECT author, tile, epoch, seq FROM sets").fetchall()
    kept = {f"{author}/{tile}": [epoch, seq] for author, tile, epoch, seq in rows}
    return {name for name, numbers in acknowledged.items() if kept.get(name, [0, 0]) < numbers}


def within(seconds: float, condition: Callable[[], bool], made: Deployed, what: str) -> None:
    try:
        eventually(condition, seconds, what)
    except AssertionError as error:
        raise AssertionError(f"{error}\n{made.logs()}") from None


@pytest.mark.thorough
def test_the_page_brings_up_three_machines_and_the_loss_of_one_costs_no_route_and_no_acknowledged_mark(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reason = why_not()
    if reason is not None:
        pytest.skip(reason)
    with deployed(tmp_path) as (made, onlooker):
        figures = lose_one(made, onlooker)
    told = ", ".join(f"{seconds:.2f} s {what}" for what, seconds in figures.items())
    with capsys.disabled():
        sys.stdout.write(f"\na machine lost for good: {told}\n")


def test_the_page_needs_few_commands() -> None:
    assert len(block("Steps", 1)) + len(block("Steps", 2)) <= COMMANDS_AT_MOST


def test_replicas_on_both_sides_of_a_partition_are_soon_equal_again(tmp_path: Path) -> None:
    reason = why_not()
    if reason is not None:
        pytest.skip(reason)
    (figures,) = partitions(1, 5.0, tmp_path)
    assert figures["digests_apart"] >= 2
    assert figures["equal_after_s"] < 5.0


if __name__ == "__main__":
    for _ in range(int(sys.argv[1])):
        with tempfile.TemporaryDirectory() as name, deployed(Path(name)) as (made, onlooker):
            sys.stdout.write(f"{lose_one(made, onlooker)}\n")
