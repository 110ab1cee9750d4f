"""The launcher's watcher hears positions at the pace at which it records them, and no more than it needs."""

from __future__ import annotations

from support.swarm_model import SwarmModel
from support.target_reports import fleet

from launch_scripts.launcher.watcher import Watcher
from launch_scripts.report.recorder import Recorder
from swarm.wire.messages.processes import Stats
from swarm.wire.messages.vehicles import Fleet, Followed
from swarm.wire.topics import FLEET, FOLLOWED, STATS


def begun(swarm: SwarmModel) -> tuple[Watcher, list[object]]:
    recorder = Recorder(swarm.scenario, swarm.terrain.grid)
    heard: list[object] = []
    record = recorder.heard
    recorder.heard = lambda message, *rest: (heard.append(message), record(message, *rest))[1]  # type: ignore[method-assign]
    watcher = Watcher(swarm.bus("launcher"), recorder, swarm.scheduler.clock)
    watcher.begin()
    return watcher, heard


def followed() -> Followed:
    return Followed(vehicle="a0-00", target="t0", start=0, directions=b"", cost_s=1.0, lower_bound_s=1.0)


def test_positions_are_taken_oftener_than_they_are_sampled_and_the_last_is_the_newest() -> None:
    swarm = SwarmModel()
    watcher, heard = begun(swarm)
    agent = swarm.bus("agent")
    for tick in range(40):
        report = fleet(100.0 * tick, ("a0-00", tick))
        agent.publish(FLEET, report, region=0, author=report.author)
        swarm.run(0.1)
        watcher.listen(0.0)
    swarm.run(0.5)
    watcher.listen(0.0)
    told = [message.seq for message in heard if isinstance(message, Fleet)]
    assert 8 <= len(told) <= 11
    assert told[-1] == 39


def test_the_first_route_that_is_begun_says_that_routes_are_served_and_the_others_are_not_heard() -> None:
    swarm = SwarmModel()
    watcher, heard = begun(swarm)
    agent = swarm.bus("agent")
    for _ in range(3):
        agent.publish(FOLLOWED, followed(), agent="a0", vehicle="a0-00")
        swarm.run(0.1)
        watcher.listen(0.0)
    assert watcher.routes_served
    assert sum(isinstance(message, Followed) for message in heard) == 1


def test_where_the_live_view_is_is_learned_from_the_figures_of_the_monitor_alone() -> None:
    swarm = SwarmModel()
    watcher, _ = begun(swarm)
    bus = swarm.bus("monitor")
    for role, port in (("agent", 8080), ("monitor", 0), ("monitor", 9090)):
        figures = Stats(
            role=role, id="0", incarnation=7, stamp_ns=1, counts={}, gauges={}, histograms={}, web_port=port
        )
        bus.publish(STATS, figures, role=role, id="0")
        swarm.run(3)
        watcher.listen(0.0)
        assert watcher.web_port == (port if role == "monitor" else 0)
