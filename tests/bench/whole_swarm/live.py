"""A swarm of real processes on this machine, measured from its start to its end."""

from __future__ import annotations

import random
import tempfile
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

from support.far_processes import Far
from support.processes import cpu_s, in_session, machine_cpu_s, pss_bytes
from support.up_process import UpProcess

from bench.harness import tell
from bench.whole_swarm.size import Size, scenario_text
from bench.whole_swarm.stats_window import StatsSpan, StatsWindow, histogram, ticks
from bench.wire.queries import beside_raw, serve_raw
from launch_scripts.launcher.takeover import processes
from launch_scripts.ports import free_ports
from launch_scripts.process_table import processes_of
from swarm.bus.bus import Heard
from swarm.bus.zenoh_bus import ZenohBus, open_bus
from swarm.config.scenario import NetworkConfig, Scenario
from swarm.config.scenario_files import parse_scenario
from swarm.endpoints import listening
from swarm.errors import BusError
from swarm.runtime.inbox import Inbox
from swarm.wire.fields import column
from swarm.wire.messages.planning import RouteRequest
from swarm.wire.messages.processes import Stats
from swarm.wire.messages.vehicles import Fleet, VehicleState
from swarm.wire.topics import FLEET, STATS

_EVERY_S = 0.05
"""From one route query of the client to the next, and from one raw get."""


def raw_answerer(network: NetworkConfig, pipe: Connection) -> None:
    """Joins on request, then answers raw queries until it is stopped."""
    pipe.send("ready")
    if pipe.recv() == "end":
        return
    with open_bus(network) as bus:
        kept = serve_raw(bus)
        pipe.send("joined")
        pipe.recv()
        del kept


def route_client(network: NetworkConfig, pipe: Connection) -> None:
    """Joins when asked to; then asks for routes, and raw, in turn.

    Answers (targets, cells, route_cells, seconds, seed) with quantiles in microseconds, and ours over raw.
    """
    pipe.send("ready")
    if pipe.recv() == "end":
        return
    with open_bus(network) as bus:
        inbox = Inbox()
        pipe.send("joined")
        while (question := pipe.recv()) != "end":
            pipe.send(beside_raw(bus, inbox, _questions(*question), _EVERY_S / 2))


def _questions(
    targets: list[str], cells: list[int], route_cells: int, seconds: float, seed: int
) -> Iterator[tuple[RouteRequest, str]]:
    chance = random.Random(seed)
    until_s = time.monotonic() + seconds
    while time.monotonic() < until_s:
        yield RouteRequest(cells=[chance.choice(cells)], max_cells=route_cells), chance.choice(targets)


UP_WITHIN_S = 240.0
"""A cold cache of kernels is compiled in it."""
ROUTED_WITHIN_S = 60.0
SETTLE_S = 3.0
_MARGIN_S = 120.0
_TURN_S = 0.2
_JOINED_WITHIN_S = 30.0
_ANSWER_S = 10.0
"""Seconds for which the client may still wait for an answer after the window."""
_ANSWERED = frozenset({VehicleState.FOLLOWING, VehicleState.ARRIVED, VehicleState.STRANDED, VehicleState.SEARCHING})
"""States of a vehicle which has a route, needs none, or knows that there is none."""
_UP = "all processes are alive"
_COUNTED = ("messages_out", "messages_in", "bytes_out", "bytes_in")
"""Counters of every bus."""


def measure_live(size: Size, seconds: float) -> dict[str, Any]:
    """Starts a swarm, measures it for some seconds once every vehicle has a route, and end it.

    Raises SwarmError if it does not come up. Leaves no process and no file, however it ends.
    """
    with tempfile.TemporaryDirectory(prefix="swarm-bench-") as folder:
        run_dir = Path(folder).resolve() / "run"
        run_dir.mkdir()
        [port] = free_ports(1)
        endpoint = f"tcp/127.0.0.1:{port}"
        file = run_dir.parent / "scale.toml"
        text = scenario_text(size, endpoint)
        file.write_text(text, encoding="utf-8")
        scenario = parse_scenario(text)
        # These start before the swarm, which leaves a busy machine no time to import anything, and join after it.
        with Far(scenario.network) as far:
            helpers = [far.start(raw_answerer), far.start(route_client)]
            began_s = time.monotonic()
            launcher = UpProcess(str(file), run_dir, UP_WITHIN_S + ROUTED_WITHIN_S + seconds + _MARGIN_S)
            run = _Run(size, scenario, seconds, launcher, began_s, helpers)
            try:
                figures = run.measure()
            finally:
                left_behind = launcher.end()
        return {**figures, **run.at_end(left_behind)}


class _Cpu(NamedTuple):
    """Seconds of CPU used until an instant: role and seconds by pid, and those of the whole machine."""

    at_s: float
    by_pid: dict[int, tuple[str, float]]
    machine_s: float


class _Run:
    """One measured run."""

    def __init__(
        self,
        size: Size,
        scenario: Scenario,
        seconds: float,
        launcher: UpProcess,
        began_s: float,
        helpers: list[Connection],
    ) -> None:
        self._size = size
        self._seconds = seconds
        self._launcher = launcher
        self._began_s = began_s
        self._helpers = helpers
        """To the processes that measure routes: the one that answers raw queries, and the client."""
        self._scenario = scenario
        self._network = scenario.network
        self._window = StatsWindow()
        self._inbox = Inbox()
        self._cells: dict[str, int] = {}
        """Vehicle -> the cell where it was heard of last."""
        self._answered: set[str] = set()
        self._not_measured: list[str] = []

    def measure(self) -> dict[str, Any]:
        self._until_listening()
        with open_bus(self._network) as bus:
            bus.subscribe(STATS, self._inbox.post)
            routed_s = self._until_routed(bus)
            asks = self._join_helpers() and bool(self._cells)
            client = self._helpers[1]
            self._listen(SETTLE_S)
            cells, route_cells = sorted(self._cells.values()), self._scenario.vehicles.route_cells
            question = (self._scenario.target_ids, cells, route_cells, self._seconds, self._scenario.seed)
            tell(f"measuring for {self._seconds:g} s")
            self._window.begin()
            before = self._cpu()
            if asks:
                client.send(question)
            self._listen(self._seconds)
            self._launcher.check()
            after = self._cpu()
            memory = self._memory()
            route = client.recv() if asks and client.poll(_ANSWER_S) else None
        figures = {
            "routed_s": routed_s,
            "routed_share": len(self._answered) / self._size.vehicles,
            "window_s": after.at_s - before.at_s,
            **self._of_cpu(before, after),
            **self._of_stats(),
            "route": route or {},
            "pss_mb": memory,
            "pss_mb_all": sum(memory.values()) if memory else None,
        }
        self._name_what_is_missing(figures)
        return figures

    def at_end(self, left_behind: list[str]) -> dict[str, Any]:
        """The report of the launcher, and the reasons for missing figures."""
        report = self._launcher.report() or {}
        if not report:
            self._not_measured.append("start-up, collisions, captures: the launcher gave no report")
        names = ("startup_s", "collisions", "lethal_entries", "captures", "restarts", "payloads_dropped")
        found = {name: report.get(name) for name in names}
        if left_behind:
            self._not_measured.append(f"an end in order: {', '.join(left_behind)} had to be killed")
        captures, lasted_s = found.pop("captures"), report.get("seconds")
        return {
            "up_s": found.pop("startup_s"),
            **found,
            "captures_per_min": None if captures is None or not lasted_s else 60 * captures / lasted_s,
            "exit_code": self._launcher.process.returncode,
            "last_words": (self._launcher.lines() or [""])[-1],
            "not_measured": self._not_measured,
        }

    # --- until it is up -------------------------------------------------------------------------------------

    def _until_listening(self) -> None:
        while not any(map(listening, self._network.connect)):
            self._launcher.check()
            self._check_time("its router listens")
            time.sleep(_TURN_S)

    def _until_routed(self, bus: ZenohBus) -> float | None:
        """Seconds from the start until every vehicle had been answered; None if some were not in time."""
        bus.subscribe(FLEET, self._inbox.post)
        up_s: float | None = None
        routed_s: float | None = None
        while routed_s is None or up_s is None:
            self._launcher.check()
            self._listen(_TURN_S)
            now_s = time.monotonic()
            if up_s is None:
                if any(line.startswith(_UP) for line in self._launcher.lines()):
                    up_s = now_s
                    tell(f"up after {now_s - self._began_s:.1f} s")
                else:
                    self._check_time("all processes are alive")
            if routed_s is None and len(self._answered) >= self._size.vehicles:
                routed_s = now_s - self._began_s
                tell(f"every vehicle has a route after {routed_s:.1f} s")
            if up_s is not None and now_s - up_s > ROUTED_WITHIN_S:
                break
        if routed_s is None:
            missing = self._size.vehicles - len(self._answered)
            self._not_measured.append(
                f"until every vehicle is routed: {missing} were not {ROUTED_WITHIN_S:g} s after the swarm was up"
            )
        bus.unsubscribe(FLEET)
        return routed_s

    def _join_helpers(self) -> bool:
        """True if the processes that measure routes have joined in time."""
        until_s = time.monotonic() + _JOINED_WITHIN_S
        for helper in self._helpers:
            helper.send("join")
        for helper in self._helpers:
            while not helper.poll():
                if time.monotonic() > until_s:
                    return False
                self._listen(_TURN_S)
            helper.recv()
        return True

    def _check_time(self, what: str) -> None:
        if time.monotonic() - self._began_s > UP_WITHIN_S:
            last = (self._launcher.lines() or ["nothing"])[-1]
            raise BusError(f"gave up waiting until {what} after {UP_WITHIN_S:g} s; the launcher said last: {last}")

    def _listen(self, for_s: float) -> None:
        """Takes in what processes publish for some seconds."""
        until_s = time.monotonic() + for_s
        while (left_s := until_s - time.monotonic()) > 0:
            match self._inbox.take(left_s):
                case Heard(message=Stats() as stats):
                    self._window.hear(stats)
                case Heard(message=Fleet() as fleet):
                    self._hear_fleet(fleet)

    def _hear_fleet(self, fleet: Fleet) -> None:
        for id, cell, state in zip(fleet.ids, column(fleet.cells, "<u4").tolist(), fleet.states, strict=True):
            self._cells[id] = cell
            if state in _ANSWERED:
                self._answered.add(id)

    # --- figures --------------------------------------------------------------------------------------------

    def _roles(self) -> Iterator[tuple[int, str]]:
        """(pid, role) of every process that the launcher has started, itself included."""
        names = {pid: name for name, pid in processes(self._launcher.run_dir).items()}
        for pid in in_session(self._launcher.session):
            if pid == self._launcher.process.pid:
                yield pid, "launcher"
            else:
                yield pid, names[pid].partition("-")[0] if pid in names else "helpers"

    def _cpu(self) -> _Cpu:
        by_pid = {pid: (role, used) for pid, role in self._roles() if (used := cpu_s(pid)) is not None}
        return _Cpu(time.monotonic(), by_pid, machine_cpu_s())

    def _memory(self) -> dict[str, float]:
        found: dict[str, float] = {}
        for pid, role in self._roles():
            if (used := pss_bytes(pid)) is not None:
                found[role] = found.get(role, 0.0) + used / 1e6
        return found

    def _of_cpu(self, before: _Cpu, after: _Cpu) -> dict[str, Any]:
        ms_per_s = 1000 / (after.at_s - before.at_s)
        by_role: dict[str, float] = {}
        for pid in before.by_pid.keys() & after.by_pid.keys():
            role, used_s = after.by_pid[pid]
            by_role[role] = by_role.get(role, 0.0) + ms_per_s * (used_s - before.by_pid[pid][1])
        every = sum(by_role.values()) if by_role else None
        others = None if every is None else max(ms_per_s * (after.machine_s - before.machine_s) - every, 0.0)
        agents, planners = by_role.get("agent"), by_role.get("planner")
        size = self._size
        return {
            "cpu_ms_per_s": dict(sorted(by_role.items(), key=lambda each: -each[1])),
            "cpu_all_ms_per_s": every,
            "cpu_others_ms_per_s": others,
            "cpu_agents_per_vehicle_ms_per_s": None if agents is None else agents / size.vehicles,
            "cpu_all_per_vehicle_ms_per_s": None if every is None else every / size.vehicles,
            "cpu_planners_per_target_ms_per_s": None if planners is None else planners / size.targets,
        }

    def _of_stats(self) -> dict[str, Any]:
        spans = self._window.spans
        expected = [(spec.role, spec.id) for spec in processes_of(self._scenario)]
        if silent := self._window.silent(expected):
            shown = ", ".join(silent[:5]) + (", ..." if len(silent) > 5 else "")
            self._not_measured.append(
                f"ticks and messages of {len(silent)} processes, which published none: {shown}"
            )

        def of(role: str) -> list[StatsSpan]:
            return [span for span in spans if span.role == role]

        agents_ms = histogram(of("agent"), "route_query_ms")
        return {
            "ticks": {role: ticks(of(role)) for role in ("agent", "planner", "targets")},
            **{f"{name}_per_s": sum(span.per_s(name) for span in spans) if spans else None for name in _COUNTED},
            "agents_route_query_p50_ms": agents_ms.quantile(0.5),
            "agents_route_query_p99_ms": agents_ms.quantile(0.99),
        }

    def _name_what_is_missing(self, figures: dict[str, Any]) -> None:
        for name, what in (("cpu_all_ms_per_s", "CPU"), ("pss_mb_all", "memory")):
            if figures[name] is None:
                self._not_measured.append(f"{what}: this system does not tell it")
        route = figures["route"]
        if not route.get("queries"):
            self._not_measured.append("route latency: no query was answered")
        elif route["unanswered"]:
            of = route["queries"] + route["unanswered"]
            self._not_measured.append(
                f"route latency of {route['unanswered']} of {of} queries, not answered in time"
            )
