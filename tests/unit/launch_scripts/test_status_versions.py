"""`swarm status` says which processes speak an older wire version, and names those that are too far apart."""

from __future__ import annotations

import io

import msgspec
from rich.console import Console
from support.client_rig import keeper_info
from support.swarm_model import SwarmModel

from launch_scripts.commands.status_view import Status, print_status, status_fields, status_of
from launch_scripts.observe.run_observer import OutsideObserver
from swarm.bus.bus import AskEnded, Replied
from swarm.grid import GridSpec
from swarm.wire.topics import RUN

INFO = keeper_info(GridSpec(4, 5, 90.0))


def told_by(**wire_versions: int) -> Status:
    """The status once agents with these wire versions have answered."""
    observer = OutsideObserver(SwarmModel().bus("status"), lambda _: None)
    for id, wire in wire_versions.items():
        info = msgspec.structs.replace(INFO, role="agent", id=id, wire_version=wire, crew=["agent-gone"])
        observer.take(Replied("observer-run", RUN, {}, info), 0)
    observer.take(AskEnded("observer-run", RUN, len(wire_versions), None), 0)
    return status_of(observer, 0)


def printed(status: Status) -> str:
    console = Console(file=io.StringIO(), width=200)
    print_status(status, console)
    text: str = console.file.getvalue()  # type: ignore[attr-defined]
    return text


def test_an_upgrade_under_way_is_shown_with_those_that_speak_the_older_version() -> None:
    status = told_by(a0=8, a1=9, a2=9)
    assert "an upgrade is under way: wire version 9, but 8 of agent-a0" in printed(status)
    assert "1 of 4 did not answer within 4 s: agent-gone" in printed(status)
    assert {each["id"]: each["wire_version"] for each in status_fields(status)["processes"]} == {
        "a0": 8, "a1": 9, "a2": 9,
    }  # fmt: skip


def test_a_process_whose_version_is_no_neighbour_of_the_run_s_is_a_stranger() -> None:
    status = told_by(a0=10, a1=8, a2=8)
    assert [info.id for info in status.strangers] == ["a0"]
    assert "stranger agent-a0 answers for run run, terrain" in printed(status)
    assert "wire version 10" in printed(status)
