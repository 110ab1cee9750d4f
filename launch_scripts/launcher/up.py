"""One run on this machine, from the terrain to the report: what `swarm demo` and `swarm up` do."""

from __future__ import annotations

import json
import logging
import math
import os
import shutil
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from launch_scripts.check.machine_check import this_machine, why_no_room
from launch_scripts.check.scenario_check import check_places, check_start
from launch_scripts.launcher import run_options
from launch_scripts.launcher.console import Terminal, live_table, plain_line, tunnel, what_is_left
from launch_scripts.launcher.fetched_terrain import fetch_if_missing, find_members, missing_files
from launch_scripts.launcher.forkserver import WarmUp
from launch_scripts.launcher.local_processes import Ending, LocalSwarm
from launch_scripts.launcher.log_file import JsonLines, Speaker, log_to
from launch_scripts.launcher.ordered_planners import OrderedPlanners, with_target
from launch_scripts.launcher.takeover import TakeOver
from launch_scripts.launcher.watcher import LauncherHealth, OwnPart, Watcher, check_vacant
from launch_scripts.observe.latest_messages import plan_of_members
from launch_scripts.observe.recorder import Recorder
from launch_scripts.observe.run_folders import LAUNCHER_LOG, REPORT_FILE, DiskWatch, begin_run, register
from launch_scripts.observe.run_observer import ask_run
from launch_scripts.plain_text import number_of
from launch_scripts.ports import check_ports, page_of
from launch_scripts.process_table import LAUNCHER, RECORDED_BESIDE, TABLE, ProcessSpec
from launch_scripts.report.report_and_tracks import make_report, write_report
from launch_scripts.stop_requests import StopAsked
from launch_scripts.web.live_page import LivePage, when_free
from shared_map.array_files import Floats
from shared_map.terrain.store import load_beside, load_terrain, load_truth, prepare, scenario_key
from shared_map.terrain.terrain import Terrain
from shared_map.terrain.terrain_report import terrain_lines
from shared_map.vehicle_class_grounds import prepare_classes
from swarm.bus.bus import Bus
from swarm.bus.zenoh_bus import open_bus
from swarm.clock import MonotonicClock, date_ns
from swarm.config.scenario import UNTIL_STOPPED_S
from swarm.endpoints import listening
from swarm.errors import BusError, StoreError, SwarmError, require
from swarm.peers import Peer, job_of
from swarm.plugins import check_plugins
from swarm.runtime.membership import check_belongs
from swarm.runtime.role_setup import RoleSetup
from swarm.runtime.run_secret import authenticator_of
from swarm.wire.messages.processes import RunInfo

log = logging.getLogger(__name__)

_TURN_S = 0.05
"""Pause of the launcher's loop at the start and the end of a run. Chosen, not measured."""
_CALM_TURN_S = 0.1
"""Once all processes are up: each turn takes a third of a millisecond."""
_LISTEN_WITHIN_S = 20.0
"""Time for the own router to listen. Chosen, not measured."""
_UP_WITHIN_S = 60.0
"""Time for the start, added to the scenario's seconds until all processes are up. Chosen, not measured."""
_RELOADED_WITHIN_S = 10.0
"""A viewer that leaves may be a page that is loaded again."""
_ELSEWHERE = f"the run is recorded and reported by the launcher that starts {RECORDED_BESIDE}"
"""Said by all others."""


def run_swarm(options: run_options.UpOptions) -> int:
    """Runs to the end. The exit code is 0 only if every process ended as it was asked to. Raises SwarmError."""
    check_start(options.scenario, joins=options.joins, has_ground=not options.asks_for_ground)
    authenticator_of(options.scenario.network, "")  # raises where the secret cannot be read or made
    for spec in options.table:
        run_options.as_process(options.scenario, spec.role, spec.id)  # raises where its certificate is missing
    check_plugins(options.scenario, options.roles)
    if "monitor" in options.roles:
        require("the monitor", "rerun")
    if not options.joins and not options.takes_over:
        check_ports(options.scenario, options.roles, (options.signals_address, options.metrics_port or 0))
    run_id, started_ns = _run_id_of(options)
    run_dir = run_options.make_run_dir(options.runs, run_id)
    log_to(run_dir / LAUNCHER_LOG, options.log_format, Speaker(LAUNCHER, "0", run_id))
    run = None
    try:
        run = _Run(options, run_id, run_dir, started_ns)
        return run.run()
    finally:
        if options.is_new and (run is None or not run.begun):
            shutil.rmtree(run_dir, ignore_errors=True)


def _run_id_of(options: run_options.UpOptions) -> tuple[str, int | None]:
    """A whole swarm is a new run. A part of one belongs to the run that it finds, or to that of its scenario. With
    the id comes when the run began, if it runs already."""
    found: list[RunInfo] = []
    if options.joins or options.takes_over:
        log_to(None, options.log_format)  # it may have to wait, and says so
        members = find_members(run_options.as_process(options.scenario, LAUNCHER, "0"))
        found = [info for info in members if info.run_id]
    run_id = options.run_id
    if run_id is None and options.is_whole and not options.takes_over:
        run_id = run_options.new_run_id()
    elif run_id is None:
        run_id = found[0].run_id if found else run_options.common_run_id(options.scenario)
    return run_id, plan_of_members(info for info in found if info.run_id == run_id).started_ns


class _Run:
    """A run in progress; all of it happens on the main thread."""

    def __init__(self, options: run_options.UpOptions, run_id: str, run_dir: Path, started_ns: int | None) -> None:
        self._options = options
        self._scenario = run_options.as_process(options.scenario, LAUNCHER, "0")
        self._run_dir = run_dir
        self._run_id = run_id
        self._started_ns = started_ns or 0
        """Time when the run began; 0 before a run that begins here."""
        lines = JsonLines(Speaker(LAUNCHER, "0", run_id)) if options.log_format == "json" else None
        self._terminal = Terminal(options.as_json, options.plain, lines)
        self._stop_asked = StopAsked()
        self._swarm = LocalSwarm(options.table, self._setup_of, run_dir, options.log_format)
        self._disk = DiskWatch(run_dir)
        self.begun = False
        """True if everything that can be refused before a process starts has been accepted."""
        self._startup_s: float | None = None
        self._web_port = 0
        self._outlasts = False
        """True while the run goes on for a viewer only."""
        self._known: Recorder | OwnPart | None = None
        self._take_over: TakeOver | None = None
        if options.takes_over:
            targets = options.scenario.target_ids
            self._take_over = TakeOver(run_dir, self._swarm.running, targets, self._terminal.say)
        self._health = LauncherHealth(options, run_id, self._swarm.seen)
        self._doing: Callable[[], str] = lambda: "preparing the terrain"
        self._page: LivePage | None = None
        """The live view's start page, until the monitor serves it."""
        view = options.scenario.monitor
        if "monitor" in options.roles and view.live and view.web_port and not options.takes_over:
            facts = {"life": "", "at_s": 0.0, "name": f"{self._scenario.name}, run {run_id}"}
            self._page = when_free(lambda: LivePage(view.web_port, lambda: {**facts, "state": self._doing()}))
            self._say_page(view.web_port)
        if self._health.url:
            self._terminal.say(f"metrics at {self._health.url}; /healthz and /readyz beside them")

    def run(self) -> int:
        """The whole run. The exit code is 0 only if all went well."""
        self._register()
        planners = any(TABLE[role].kernels for role in self._options.roles)
        self._warm_up = WarmUp(self._scenario if planners else None)
        try:
            return self._run()
        finally:
            self._warm_up.close()
            self._health.close()
            self._leave_page()

    def _run(self) -> int:
        with self._terminal.busy(lambda: self._doing()):
            prepared = self._stop_asked.interruptible(self._prepared)
        if prepared is None:
            return self._stopped_early()
        self._terrain, self._truth = prepared
        if self._page is not None:
            self._page.terrain = self._terrain
        homes = load_beside(self._run_dir, "homes", scenario_key(self._scenario))
        check_places(self._scenario, self._terrain, self._truth, homes)
        self.begun = True
        records = self._options.records
        for sentence in begin_run(self._run_dir, self._options.scenario, self._run_id, recorded=records):
            self._terminal.say(sentence, "yellow")
        if self._options.run_id is None and not self._options.takes_over and (self._run_dir / REPORT_FILE).exists():
            self._terminal.say(f"run {self._run_id} continues: there is a report of it already", "yellow")
        log.info("terrain is ready")
        if not self._waited(lambda: self._warm_up.progress, self._warm_up.done):
            return self._stopped_early()
        log.info("kernels are loaded")
        failures: list[str] = []
        self._started_ns = self._started_ns or date_ns()
        try:
            if not self._options.joins and "router" in self._options.roles:
                self._swarm.start("router")
            within_s = math.inf if self._options.joins else _LISTEN_WITHIN_S
            if not self._waited(lambda: "waiting for the router to listen", self._router_listens, within_s):
                self._swarm.stop(lambda: time.sleep(_TURN_S), force=self._stop_asked.force)
                return self._stopped_early()
            log.info("the router listens")
            network = self._scenario.network
            with open_bus(network, authenticator=authenticator_of(network, self._run_id)) as bus:
                self._join(bus)
                self._say_begin()
                grid, since_ns = self._terrain.grid, self._started_ns
                known = Recorder(self._scenario, grid, since_ns) if records else OwnPart(grid, since_ns)
                self._known = known
                watcher = Watcher(bus, known, MonotonicClock())
                watcher.set_own([running.spec for running in self._swarm.running])
                try:
                    self._leave_page()
                    self._swarm.start()
                    log.info("all processes are started")
                    seconds = self._watch(watcher)
                finally:
                    failures = self._stop(watcher)
        finally:
            self._terminal.close()
            self._swarm.kill()
        if self._startup_s is None and not self._stop_asked:
            missing = ", ".join(self._missing(watcher)) or "routes"
            busy = f"load {os.getloadavg()[0]:.0f} on {len(os.sched_getaffinity(0))} cores"
            failures.insert(0, f"the swarm was never whole: missing {missing} ({busy})")
        has_run = isinstance(known, OwnPart) or known.routed or not failures
        code = self._end(known, seconds, failures) if has_run else 0
        for failure in failures:
            self._terminal.say(failure, "red")
        return 1 if failures else code

    def _leave_page(self) -> None:
        """Leaves the live view's port to the monitor."""
        if self._page is not None:
            self._page.server.close()
            self._page = None

    def _stopped_early(self) -> int:
        self._terminal.say("stopped before the swarm was up: there is nothing to report", "yellow")
        return self._stop_asked.exit_code

    def _prepared(self) -> tuple[Terrain, Floats]:
        """Builds the terrain from its files, or fetches it from a keeper where one is missing and a swarm runs."""
        if self._options.asks_for_ground and missing_files(self._scenario):
            found = [info for info in find_members(self._scenario) if info.run_id]
            fetch_if_missing(
                self._scenario, self._run_dir, found, roles=self._options.roles, progress=self._prepares
            )
            setup = self._setup_of(ProcessSpec(LAUNCHER, "0"))
            terrain = load_terrain(setup)
            truth = load_truth(setup, terrain)
        else:
            terrain, truth = prepare(self._run_dir, self._scenario, self._prepares)
        prepare_classes(self._run_dir, self._scenario, terrain, truth)
        return terrain, truth

    def _prepares(self, what: str, share: float) -> None:
        self._doing = lambda: f"preparing the terrain: {what}, {share:.0%}"

    def _setup_of(self, spec: ProcessSpec) -> RoleSetup:
        scenario = run_options.as_process(self._options.scenario, spec.role, spec.id)
        incarnation = run_options.next_incarnation(self._run_dir, spec.role, spec.id)
        before = None
        if self._known is not None:
            observed = self._known.observed
            before = observed.newest_stats(spec.role, spec.id)
            if spec.role == "planner":
                scenario = with_target(scenario, observed.book, job_of(spec.id))
            if self._take_over is None:  # else those before are its own, too
                observed.started(Peer(spec.role, spec.id, incarnation))
        return RoleSetup(
            scenario=scenario,
            run_id=self._run_id,
            role=spec.role,
            id=spec.id,
            incarnation=incarnation,
            started_ns=self._started_ns,
            run_dir=self._run_dir,
            record_inputs=self._options.record_inputs,
            anew=self._options.is_new,
            before=before,
        )

    def _waited(self, text: Callable[[], str], done: Callable[[float], bool], within_s: float = 600.0) -> bool:
        """Waits for `done(timeout_s)`, and shows so if it takes long. Returns False if a signal ended that."""
        began_s, self._doing = time.monotonic(), text
        with self._terminal.busy(text):
            while not self._stop_asked and not done(_TURN_S):
                if time.monotonic() - began_s > within_s:
                    raise BusError(f"gave up {text()} after {within_s:g} s; see {self._run_dir}")
        return not self._stop_asked

    def _router_listens(self, timeout_s: float) -> bool:
        self._raise_refusals(self._swarm.poll())
        if any(map(listening, self._scenario.network.connect)):
            return True
        time.sleep(timeout_s)
        return False

    def _join(self, bus: Bus) -> None:
        """Refuses to share a namespace with another run, or to start a process that runs already."""
        if not self._options.joins and self._take_over is None:
            return
        found = ask_run(bus)
        mine = self._setup_of(ProcessSpec(LAUNCHER, "0")).info(self._terrain.grid, self._terrain.digest)
        check_belongs(mine, found)
        followed = () if self._take_over is None else self._take_over.predecessors
        for running in self._swarm.running:
            if running.spec.name not in followed:
                check_vacant(found, running.spec.role, running.spec.id)

    def _watch(self, watcher: Watcher) -> float:
        """Watches the run until its time is over or a signal comes. Returns the seconds that it lasted."""
        began_s = watched_s = time.monotonic()
        options, observed = self._options, watcher.known.observed

        def no_room(planners: int) -> str | None:
            return why_no_room(self._scenario, self._terrain.grid.cells, planners, this_machine(self._run_dir))

        whole, say = options.is_whole and not options.joins, self._terminal.say
        ordered = OrderedPlanners(
            self._scenario, self._swarm, options.ranks_of_added, options.table, whole, say, no_room
        )
        while not self._stop_asked:
            ordered.follow_orders(observed.book, set(observed.up()), time.monotonic())
            watcher.set_own([running.spec for running in self._swarm.running])
            if self._take_over is not None:
                self._take_over.advance(time.monotonic())
            self._raise_refusals(self._swarm.poll())
            watcher.listen(_TURN_S if self._startup_s is None else _CALM_TURN_S)
            self._on_turn(watcher)
            now_s = time.monotonic()
            if self._startup_s is None and self._is_up(watcher):
                self._startup_s = now_s - self._options.began_s
                began_s = now_s
                served = watcher.routes_served or not self._all_external
                so_far = "routes are served" if served else "targets wait for their trackers"
                so_far += f", {self._startup_s:.1f} s after launch{self._limit('; the run lasts')}"
                self._terminal.say(f"all processes are alive and {so_far}")
                self._register()  # `up -d` shows what was said before
                # Only now: its corners in degrees take a library that is large.
                for line in terrain_lines(self._terrain):
                    self._terminal.say(line)
            # Time counts from when the swarm is up; one that never comes up must end too.
            limit_s = self._scenario.seconds + (_UP_WITHIN_S if self._startup_s is None else 0.0)
            watched_s = now_s if watcher.viewers else watched_s
            stays = self._options.stays_watched and self._startup_s is not None
            self._outlasts = stays and now_s - began_s >= limit_s and now_s - watched_s < _RELOADED_WITHIN_S
            if now_s - began_s >= limit_s and not self._outlasts:
                break
        return time.monotonic() - began_s

    def _is_up(self, watcher: Watcher) -> bool:
        if self._missing(watcher) or (self._take_over is not None and not self._take_over.done):
            return False
        return "planner" not in self._options.roles or watcher.routes_served or self._all_external

    @property
    def _all_external(self) -> bool:
        """Returns True if no route is served before an external tracker publishes its target."""
        return not any(target.is_simulated for target in self._scenario.targets)

    def _missing(self, watcher: Watcher) -> list[str]:
        specs = [running.spec for running in self._swarm.running]
        return [spec.name for spec in specs if not watcher.known.observed.was_up(spec.role, spec.id)]

    def _on_turn(self, watcher: Watcher) -> None:
        known = watcher.known
        up = known.own_up() if isinstance(known, OwnPart) else None
        self._health.on_turn(known.observed, self._started_ns, self._missing(watcher), up)
        if (sentence := self._disk.check_room(time.monotonic())) is not None:
            self._terminal.say(sentence, "red")
        for note in watcher.take_notes(starting=self._startup_s is None):
            self._terminal.say(f"{note.role}-{note.id}: {note.text}", "cyan")
        if watcher.web_port not in (0, self._web_port):
            self._say_page(watcher.web_port)
            self._register()
        if self._terminal.due():
            self._show(known, watcher.now_ns(), self._missing(watcher))

    def _say_page(self, port: int) -> None:
        """States the one address of the run's page. It shows the terrain first, and the live view once the monitor
        has loaded it."""
        self._web_port = port
        self._terminal.say(f"open {page_of(port)}: the terrain now, the live view in a moment", "bold")
        self._terminal.say(f"from another computer: run `{tunnel(port)}` there, then open the same address")

    def _register(self, **progress: bool) -> None:
        """Registers the run's progress for other commands; `begin_run` has reported any failure."""
        register(self._run_dir, web_port=self._web_port, is_whole=self._startup_s is not None, **progress)

    def _show(self, known: Recorder | OwnPart, now_ns: int, missing: list[str]) -> None:
        up = f"{len(self._swarm.running) - len(missing)} of {len(self._swarm.running)}"
        if isinstance(known, OwnPart):
            title = self._title(up, missing)
            self._terminal.show(lambda: known.line(title, now_ns, self._swarm.restarts))
            return
        state = known.summary(now_ns)
        missing = missing or [number_of(all - up, role) for role, (up, all) in state.crew.items() if up < all]
        title = self._title(up, missing)
        self._terminal.show(lambda: plain_line(state, title), lambda console: live_table(state, title, console))

    def _title(self, up: str, missing: list[str]) -> str:
        """Returns the title line of the displays. Its time is that of the start-up, and then that of the run, as
        the numbers at the end have them."""
        since_s = time.monotonic() - self._options.began_s - (self._startup_s or 0.0)
        if self._startup_s is None:
            waits = f", waits for {', '.join(missing) or 'the first route'}" * (len(missing) < 4)
            return f"{self._scenario.name}: starting, {up} processes started here are up{waits}, {since_s:.0f} s"
        until = ", until the live view is closed, or Ctrl-C" if self._outlasts else self._limit(" of")
        live = f", page {page_of(self._web_port)}" if self._web_port else ""
        return f"{self._scenario.name}: {since_s:.0f} s{until}{live}"

    def _limit(self, word: str) -> str:
        """Returns the word and how long the run lasts once the swarm is up; nothing if that has no limit."""
        return f"{word} {self._scenario.seconds:g} s" if self._scenario.seconds < UNTIL_STOPPED_S else ""

    def _raise_refusals(self, endings: list[Ending]) -> None:
        for ending in endings:
            if ending.restart_in_s is None:
                error = SwarmError(f"{ending.spec.name}: {ending.sentence}")
                error.exit_code = ending.exit_code
                raise error
            if ending.times <= 3 or ending.times % 10 == 0:
                again = f"starts again in {ending.restart_in_s:g} s"
                times = f", time {ending.times}" if ending.times > 1 else ""
                self._terminal.say(f"{ending.spec.name}: {ending.sentence}; {again}{times}", "yellow")

    def _stop(self, watcher: Watcher) -> list[str]:
        """Stops all roles in order, and records their last messages."""
        self._health.ends()
        self._terminal.close()
        asked = "; once more, and what still runs is killed" if self._stop_asked else ""
        self._terminal.say(f"stopping{asked}")
        self._register(is_ending=True)
        swarm = self._swarm
        watcher.end([running.spec for running in swarm.running])
        with self._terminal.busy(
            lambda: f"stopping: {len(swarm.alive)} of {len(swarm.running)} processes still run"
        ):
            failures = swarm.stop(lambda: watcher.listen(_TURN_S), force=self._stop_asked.force)
            watcher.finish()
        if names := swarm.cut_short:
            self._terminal.say(f"killed, as asked: {', '.join(names)}", "yellow")
        return failures

    def _end(self, known: Recorder | OwnPart, seconds: float, failures: list[str]) -> int:
        """Writes what the run leaves, and says where it is. Returns 0 if it is whole and nothing was cut short."""
        try:
            with self._terminal.busy("writing the report and its picture"):
                whole = self._stop_asked.interruptible(lambda: self._report(known, seconds, failures), anew=True)
        except StoreError as error:
            self._terminal.say(str(error), "red")
            return error.exit_code
        if whole is None:
            self._terminal.say("the rest of the report is left out, as requested", "yellow")
        if not self._options.as_json:
            for line in what_is_left(self._run_dir):
                self._terminal.say(line)
        return 0 if whole and not self._swarm.cut_short else self._stop_asked.exit_code

    def _say_begin(self) -> None:
        many = Counter(spec.role for spec in self._options.table)
        processes = ", ".join(f"{number} {role}" for role, number in many.items())
        scenario = self._scenario
        self._terminal.say(f"run {self._run_id}: scenario {scenario.name}, seed {scenario.seed}, {processes}")
        left = "logs, recording and report" if self._options.records else f"{_ELSEWHERE}; logs"
        starts = "router" in self._options.roles and not self._options.joins
        routers = scenario.network.listen if starts else scenario.network.connect[:1]
        self._terminal.say(f"router at {', '.join(routers)}; {left} in {self._run_dir}")

    def _report(self, known: Recorder | OwnPart, seconds: float, failures: list[str]) -> bool:
        """Prints the numbers of the run and writes its report; of a part says where that is. Raises StoreError."""
        measured: dict[str, Any] = {"run_id": self._run_id, "seconds": seconds, "startup_s": self._startup_s}
        as_json = self._options.as_json
        if isinstance(known, OwnPart):
            if as_json:
                part = {**measured, "recorded": False, "restarts": self._swarm.restarts}
                self._terminal.print_json(json.dumps(part, indent=2))
            else:
                self._terminal.say(f"{_ELSEWHERE}; in {self._run_dir} are the logs of this machine's processes")
            return True
        report = make_report(known, self._terrain, failures=failures, **measured)
        numbers = {name: value for name, value in report.items() if name not in ("series", "by_vehicle")}
        if as_json:
            self._terminal.print_json(json.dumps(numbers, indent=2))
        else:
            self._terminal.report(numbers)
        # Results are written first, so that a full disk does not prevent them.
        write_report(self._run_dir, report, known, self._terrain, truth=self._truth)
        return True
