"""The version before this one and this one in one run, as real processes, machine by machine.

The longest time of a vehicle without a route while three machines go from the version before to this one:
`PYTHONPATH=.:tests python tests/live/test_two_versions.py`, and with `--stop-first` without taking over."""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

import pytest
from support.launchers import THREE, TWO, Machine, Routed, machines_of, shared_kernels
from support.live_swarm import client
from support.neighbour import ROOT, neighbour_tree
from support.processes import eventually

from swarm.bus.bus import Event, Heard
from swarm.config.scenario import NetworkConfig
from swarm.wire.messages.processes import Stats
from swarm.wire.topics import STATS

pytestmark = [pytest.mark.network, pytest.mark.slow]


def older_tree(folder: Path) -> Path:
    """The version before, which finds the kernels that this one has compiled."""
    tree = neighbour_tree(folder)
    shared_kernels(tree)
    return tree


def check_understood(network: NetworkConfig, processes: int) -> None:
    """All processes have published their counters: none has dropped a payload or found a stranger."""
    counted: dict[tuple[str, str], Mapping[str, int]] = {}

    def hear(event: Event) -> None:
        assert isinstance(event, Heard)
        assert isinstance(event.message, Stats)
        counted[event.message.role, event.message.id] = event.message.counts

    with client(network) as bus:
        bus.subscribe(STATS, hear)
        eventually(lambda: len(counted) == processes, 60, "what all processes count")
    wrong = ("payloads_dropped", "strangers")
    assert {name: counts for name, counts in counted.items() if any(map(counts.get, wrong))} == {}


def take_over(machine: Machine, tree: Path) -> None:
    """Goes over to the version in `tree`, beside the one that runs."""
    before = machine.process
    machine.start(tree, "--take-over")
    eventually(lambda: machine.lives and before.poll() is not None, 120, "the end of the launcher before")
    assert before.returncode == 0, machine.said()
    eventually(machine.up, 120, "the successors")


def stop_first(machine: Machine, tree: Path) -> None:
    """Goes over to the version in `tree` once the one that runs has ended."""
    assert machine.stop() == 0, machine.said()
    machine.start(tree)
    eventually(machine.up, 120, "the successors")


def test_two_versions_understand_each_other_and_one_takes_over_from_the_other(tmp_path: Path) -> None:
    trees = {"base": older_tree(tmp_path), "planners": ROOT}
    with machines_of(TWO, trees, tmp_path) as (machines, routed, network):
        check_understood(network, 7)
        take_over(machines["base"], ROOT)
        routed.again(60)
        check_understood(network, 7)


@pytest.mark.thorough
def test_three_machines_are_upgraded_one_after_the_other(tmp_path: Path) -> None:
    old = older_tree(tmp_path)
    with machines_of(THREE, dict.fromkeys(THREE, old), tmp_path) as (machines, routed, network):
        for machine in machines.values():
            take_over(machine, ROOT)
            routed.again(60)
        check_understood(network, 10)


def measured(routed: Routed, machine: Machine, over: bool) -> float:
    routed.begin()
    (take_over if over else stop_first)(machine, ROOT)
    routed.again(60)
    return routed.longest_s()


if __name__ == "__main__":
    over = "--stop-first" not in sys.argv
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        old = older_tree(folder)
        with machines_of(THREE, dict.fromkeys(THREE, old), folder) as (machines, routed, _):
            routed.begin()
            time.sleep(10)
            sys.stdout.write(f"nothing done: {routed.longest_s():.2f} s\n")
            for each in ("field", "planners", "base"):
                sys.stdout.write(f"{each}: {measured(routed, machines[each], over):.2f} s\n")
