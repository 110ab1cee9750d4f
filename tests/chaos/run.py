"""A live swarm of real processes under faults, from its start to its end."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from bench.harness import Seed, benchmark, tell
from support.message_fuzzer import NAMES, MessageFuzzer
from support.processes import usage
from support.up_process import UpProcess

from chaos.attacker import Attacker
from chaos.fault_schedule import FAULTS, Fault, faults
from chaos.hostile import Hostile
from chaos.results import LAUNCHER, Ended, Outcome, Recovery, Results, Sample, name_of
from launch_scripts.launcher.run_options import find_scenario, make_run_dir, with_port
from launch_scripts.launcher.takeover import has_ended, processes
from launch_scripts.process_table import processes_of
from launch_scripts.simulation.world.referee import Referee
from shared_map.terrain.terrain import build_terrain
from shared_map.terrain.true_ground import build_truth
from shared_map.vehicle_class_grounds import class_truths
from swarm.config.scenario import Scenario, plan_agents, traffic_grid
from swarm.config.vehicle_classes import aloft_classes
from swarm.endpoints import listening
from swarm.errors import BusError, ConfigError, ProtocolError, StoreError
from swarm.wire.codec import decode
from swarm.wire.topics import FLEET

_UP_WITHIN_S = 180.0
_SETTLE_S = 5.0
_WATCH_S = 30.0
"""A fault that has not recovered by then never does."""
_SCAN_S = 0.2
_SAMPLE_S = 5.0
_AT_ONCE = 100
"""Hostile messages between two checks of the received messages."""
_MATERIAL_S = 1.0
"""All messages in these seconds before each burst are kept as material."""
_MESSAGES_PER_S = 2000.0
"""Faster ones would be dropped by our own session, and not reach the router."""
_MARGIN_S = 600.0


@dataclass(frozen=True, slots=True)
class Options:
    """Options of a run under faults.

    scenario  a file or a built-in name
    seconds   the run ends after this time; None: with the messages
    messages  number of hostile messages after which the run ends; None: it ends with the seconds
    every_s   from one fault to the next, at least
    kinds     which faults
    within_s  a fault from which the swarm recovers later breaks a law
    spared    processes that nothing falls on: what they keep over the whole run shows
    """

    scenario: str
    seconds: float | None
    messages: int | None
    seed: int
    every_s: float
    kinds: tuple[str, ...]
    within_s: float
    spared: tuple[str, ...]
    runs: Path


@benchmark(fails=("broken", "interrupted"))
def chaos(
    scenario: Annotated[
        str, typer.Argument(metavar="SCENARIO", help="A .toml file, or the name of a built-in scenario.")
    ] = "besieged",
    seconds: Annotated[float | None, typer.Option(min=1, max=1e6, help="End after so many seconds.")] = None,
    messages: Annotated[
        int | None, typer.Option(min=1, help="End once so many hostile messages have been sent.")
    ] = None,
    blow: Annotated[
        list[str] | None, typer.Option(help="Only this: kill, hang or messages; may be given several times.")
    ] = None,
    every: Annotated[float, typer.Option(min=1, help="Seconds from one blow to the next, at least.")] = 10.0,
    within: Annotated[
        float, typer.Option(min=0.1, help="Recovering later than so many seconds breaks a law.")
    ] = 10.0,
    spare: Annotated[
        list[str] | None, typer.Option(help="Not this process, such as monitor-0: shows whether it grows.")
    ] = None,
    seed: Seed = 1,
    runs: Annotated[Path, typer.Option(help="Folder of the folder for logs and chaos.json.")] = Path("runs"),
) -> dict[str, Any]:
    """A swarm on this machine is started and struck: how soon does it recover?

    \b
    ./launch_scripts/bench chaos --seconds 60
    ./launch_scripts/bench chaos --blow kill --every 45 --spare monitor-0 --seconds 3600
    ./launch_scripts/bench chaos --blow messages --messages 1000000

    Processes are killed (kill -9 of one or two) or stopped for a while, and messages are said with flipped bits,
    hostile numbers, replayed, or as well-formed lies. Lasts a minute unless --seconds or --messages say more. Exit
    code 1 if a process ended by itself, vehicles did not recover in time or met, or memory grew. Leaves chaos.json
    in the run's folder.
    """
    for each in blow or ():
        if each not in FAULTS:
            raise ConfigError(f"--blow: no {each!r}; there are {', '.join(FAULTS)}")
    options = Options(
        scenario=scenario,
        seconds=60.0 if seconds is None and messages is None else seconds,
        messages=messages,
        seed=seed,
        every_s=every,
        kinds=tuple(blow or FAULTS),
        within_s=within,
        spared=tuple(spare or ()),
        runs=runs,
    )
    run = ChaosRun(options)
    tell(f"logs and chaos.json in {run.run_dir}")
    interrupted = False
    try:
        run.run()
    except KeyboardInterrupt:
        interrupted = True
        tell("interrupted: the figures are of the part that has run")
    report = run.results.report()
    try:
        (run.run_dir / "chaos.json").write_text(json.dumps(report, indent=1))
    except OSError as error:
        raise StoreError(f"cannot write {run.run_dir / 'chaos.json'}: {error.strerror or error}") from error
    del report["samples"]
    shown = {name: report[name] for name in ("rows", "minutes", "seconds", "messages", "growth")}
    notes = [f"broken: {sentence}" for sentence in report["broken"]]
    return {**report, "interrupted": interrupted, "shown": shown, "notes": notes}


class ChaosRun:
    """One run, whose `results` say what it came to. It leaves no process behind, whatever happens."""

    def __init__(self, options: Options) -> None:
        self._options = options
        scenario = with_port(find_scenario(options.scenario), 0)
        self._scenario: Scenario = scenario
        terrain = build_terrain(scenario)
        self._referee = Referee(
            class_truths(scenario, terrain, build_truth(scenario, terrain)),
            traffic_grid(scenario, terrain.grid),
            aloft_classes(scenario),
        )
        vehicles = [id for plan in plan_agents(scenario) for id in plan.vehicle_ids]
        self._recovery = Recovery(vehicles)
        self._names = [spec.name for spec in processes_of(scenario)]
        if unknown := set(options.spared) - set(self._names):
            raise ConfigError(f"--spare: no {min(unknown)!r}; there are {', '.join(self._names)}")
        self._struck = [name for name in self._names if name not in options.spared]
        names = (*NAMES, *scenario.target_ids, *(plan.id for plan in plan_agents(scenario)), *vehicles)
        classes = [each.name for each in scenario.classes]
        fuzzer = MessageFuzzer(terrain.grid, options.seed, tuple(dict.fromkeys(names)), classes)
        namespace = scenario.network.namespace
        self._hostile = Hostile(namespace, fuzzer, options.seed)
        self.run_dir = make_run_dir(options.runs, f"chaos-{time.strftime('%Y%m%d-%H%M%S')}-{options.seed}")
        self.results = Results(
            scenario=options.scenario,
            seed=options.seed,
            within_s=options.within_s,
            spared=(LAUNCHER, *options.spared),
        )
        self._began_s = time.monotonic()
        self._launcher_pid = 0
        self._pids: dict[str, int] = {}
        self._killed: set[int] = set()
        self._stopped: set[int] = set()
        self._scan_due_s = self._sample_due_s = 0.0

    @property
    def _now_s(self) -> float:
        """Seconds since the first fault."""
        return time.monotonic() - self._began_s

    def run(self) -> None:
        """Strikes to the end. Raises SwarmError if the swarm does not come up."""
        with self._swarm() as launcher:
            attacker = self._join(launcher)
            try:
                self._began_s = time.monotonic()
                self._scan_due_s = self._sample_due_s = 0.0
                self._strike_all(launcher, attacker)
            finally:
                self.results.seconds = self._now_s
                for pid in self._stopped:
                    _send(pid, signal.SIGCONT)
                attacker.close()

    # --- the swarm ------------------------------------------------------------------------------------------

    @contextlib.contextmanager
    def _swarm(self) -> Iterator[UpProcess]:
        """`swarm up`; ends it, and all that it started."""
        port = self._scenario.network.connect[0].rpartition(":")[2]
        limit_s = (self._options.seconds or _LONGEST_S) + _MARGIN_S
        launcher = UpProcess(self._options.scenario, self.run_dir, limit_s, "--port", port)
        self._launcher_pid = launcher.process.pid
        try:
            yield launcher
        finally:
            self.results.left_behind += launcher.end()

    def _join(self, launcher: UpProcess) -> Attacker:
        """Waits until the swarm is up and every vehicle has been heard of."""
        began_s = time.monotonic()
        attacker: Attacker | None = None
        try:
            while time.monotonic() < began_s + _UP_WITHIN_S:
                launcher.check()
                if attacker is None:
                    if listening(self._scenario.network.connect[0]):
                        attacker = Attacker(self._scenario.network)
                    else:
                        time.sleep(0.2)
                    continue
                self._listen(attacker, 0.5)
                if self._recovery.reported and len(self._pids) >= len(self._names):
                    tell(f"up after {time.monotonic() - began_s:.1f} s; settling {_SETTLE_S:g} s")
                    self._listen(attacker, _SETTLE_S)
                    return attacker
            raise BusError(f"the swarm did not come up within {_UP_WITHIN_S:g} s; see {self.run_dir}")
        except BaseException:
            if attacker is not None:
                attacker.close()
            raise

    # --- faults ----------------------------------------------------------------------------------------------

    def _strike_all(self, launcher: UpProcess, attacker: Attacker) -> None:
        options = self._options
        for number, fault in enumerate(faults(options.seed, self._struck, options.kinds, options.every_s / 2)):
            if self._finished():
                return
            if (code := launcher.process.poll()) is not None:
                self.results.ended.append(Ended(at_s=self._now_s, name="launcher", reason=f"exit code {code}"))
                return
            began_s = self._now_s
            outcome = self._strike(attacker, fault)
            self.results.outcomes.append(outcome)
            tell(f"{number} {_sentence(outcome)}")
            self._listen(attacker, max(began_s + options.every_s - self._now_s, 0.5))

    def _finished(self) -> bool:
        options = self._options
        told = sum(self.results.messages.values())
        return (options.seconds is not None and self._now_s >= options.seconds) or (
            options.messages is not None and told >= options.messages
        )

    def _strike(self, attacker: Attacker, fault: Fault) -> Outcome:
        at_s = from_s = self._now_s
        many, back_s = 0, 0.0
        match fault.kind:
            case "kill":
                back_s = self._kill(attacker, fault.whom)
            case "hang":
                self._hang(attacker, fault)
                from_s = self._now_s
            case "messages":
                many = self._burst(attacker, fault.lasts_s)
                from_s = self._now_s
        recovery = self._recovery
        recovery.over(self._now_s)
        until_s = self._now_s + _WATCH_S
        while self._now_s < until_s and (recovery.routed_s() is None or recovery.moving_s() is None):
            self._listen(attacker, 0.05)
        routed_s, moving_s = recovery.routed_s(), recovery.moving_s()
        return Outcome(
            at_s=at_s,
            kind=fault.kind,
            whom=fault.whom,
            lasts_s=fault.lasts_s,
            messages=many,
            back_s=back_s,
            routed_s=None if routed_s is None else routed_s - from_s,
            moving_s=None if moving_s is None else moving_s - from_s,
            late=tuple(recovery.unrouted() or recovery.standing()),
        )

    def _kill(self, attacker: Attacker, names: tuple[str, ...]) -> float:
        """Kills processes; returns the seconds until others run in their place."""
        self._scan()
        began_s = self._now_s
        before = {name: self._pids[name] for name in names if name in self._pids}
        for pid in before.values():
            self._killed.add(pid)
            _send(pid, signal.SIGKILL)
        while any(self._pids.get(name) in (None, pid) for name, pid in before.items()):
            if self._now_s > began_s + _WATCH_S:
                break
            self._listen(attacker, 0.05)
            self._scan()
        return self._now_s - began_s

    def _hang(self, attacker: Attacker, fault: Fault) -> None:
        self._scan()
        pids = [self._pids[name] for name in fault.whom if name in self._pids]
        self._stopped.update(pids)
        for pid in pids:
            _send(pid, signal.SIGSTOP)
        self._listen(attacker, fault.lasts_s)
        for pid in pids:
            _send(pid, signal.SIGCONT)
        self._stopped.clear()

    def _burst(self, attacker: Attacker, lasts_s: float) -> int:
        with attacker.listening_to_all() as last:
            self._listen(attacker, _MATERIAL_S)
        for key, sample in sorted(last.items()):
            code = None if sample.attachment is None else sample.attachment.to_bytes()
            self._hostile.heard(key, sample.payload.to_bytes(), code)
        began_s, many = self._now_s, 0
        while self._now_s < began_s + lasts_s and not self._finished():
            for _ in range(_AT_ONCE):
                kind, key, payload, code = self._hostile.next()
                attacker.say(key, payload, code)
                self.results.messages[kind] = self.results.messages.get(kind, 0) + 1
                many += 1
            self._listen(attacker, max(began_s + many / _MESSAGES_PER_S - self._now_s, 0.0))
        return many

    # --- watching -------------------------------------------------------------------------------------------

    def _listen(self, attacker: Attacker, seconds: float) -> None:
        """Listens for this many seconds; checks the processes when it is time."""
        until_s = self._now_s + seconds
        while True:
            for payload in attacker.reports(min(max(until_s - self._now_s, 0.0), 0.05)):
                self._hear(payload)
            now_s = self._now_s
            if now_s >= self._scan_due_s:
                self._scan_due_s = now_s + _SCAN_S
                self._scan()
            if now_s >= self._sample_due_s:
                self._sample_due_s = now_s + _SAMPLE_S
                self._sample(attacker)
            if now_s >= until_s:
                return

    def _hear(self, payload: bytes) -> None:
        with contextlib.suppress(ProtocolError):
            fleet = decode(payload, FLEET.message)
            self._recovery.hear(fleet, self._now_s)  # type: ignore[arg-type]
            for broken in self._referee.on_fleet(fleet):  # type: ignore[arg-type]
                text = f"{broken.vehicles} on cell {broken.cell} at {self._now_s:.1f} s"
                met = broken.count == "collisions"
                (self.results.collisions if met else self.results.lethal_entries).append(text)

    def _scan(self) -> None:
        """Scans for processes that run now, and for those that have ended without being killed."""
        gone = [(name, pid) for name, pid in self._pids.items() if has_ended(pid)]
        for name, pid in gone:
            del self._pids[name]
            if pid not in self._killed:
                self.results.ended.append(Ended(at_s=self._now_s, name=name, reason=self._reason(name)))
                tell(f"{name} ended by itself at {self._now_s:.1f} s")
        # A search is the most expensive part, so only missing entries are searched.
        if len(self._pids) < len(self._names):
            self._pids.update(processes(self.run_dir))

    def _reason(self, name: str) -> str:
        """The last sentence of the launcher about it."""
        with contextlib.suppress(OSError):
            lines = (self.run_dir / "up.log").read_text(errors="replace").splitlines()
            return next((line[:300] for line in reversed(lines) if line.startswith(f"{name}: ")), "without a word")
        return "without a word"

    def _sample(self, attacker: Attacker) -> None:
        pids = {LAUNCHER: self._launcher_pid, **self._pids}
        used = {name: each for name, pid in pids.items() if (each := usage(pid)) is not None}
        if len(used) > len(self._names):
            self.results.samples.append(
                Sample(
                    at_s=self._now_s,
                    rss_mb={name: each.rss_bytes / 1e6 for name, each in used.items()},
                    threads=sum(each.threads for each in used.values()),
                    files=sum(each.files for each in used.values()),
                    disk_mb=sum(each.stat().st_size for each in self.run_dir.rglob("*") if each.is_file()) / 1e6,
                    captures=attacker.captures(),
                )
            )


_LONGEST_S = 6 * 3600.0


def _sentence(outcome: Outcome) -> str:
    if outcome.recovered_s is None:
        rest = f"NOT RECOVERED: {len(outcome.late)} vehicles, such as {', '.join(outcome.late[:3])}"
    else:
        rest = f"routed after {outcome.routed_s:.2f} s, moving after {outcome.moving_s:.2f} s"
    return f"at {outcome.at_s:.0f} s {name_of(outcome)}: {rest}"


def _send(pid: int, number: signal.Signals) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, number)
