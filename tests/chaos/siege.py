"""A live swarm of real processes under blows, from its start to its end."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from support.process_usage import Usage, usage
from support.up_process import UpProcess

from chaos.blows import BLOWS, Blow, blows
from chaos.hostile import KINDS, Hostile
from chaos.lies import NAMES, Lies
from chaos.recovery import Recovery
from chaos.stranger import Stranger
from chaos.tally import Ended, Outcome, Sample, Tally, name_of
from launch_scripts.launcher.options import find_scenario, make_run_dir, with_port
from launch_scripts.launcher.takeover import has_ended, processes
from launch_scripts.process_table import processes_of
from launch_scripts.simulation.world.referee import Collision, Referee
from shared_map.class_grounds import class_truths
from shared_map.terrain.terrain import build_terrain, build_truth
from swarm.bus.endpoints import listening
from swarm.config.agents import plan_agents
from swarm.config.classes import aloft_classes
from swarm.config.scenario import Scenario
from swarm.errors import BusError, ProtocolError
from swarm.wire.codec import decode
from swarm.wire.topics import FLEET

_UP_WITHIN_S = 180.0
_SETTLE_S = 5.0
_WATCH_S = 30.0
"""A blow that has not recovered by then never does."""
_SCAN_S = 0.2
_SAMPLE_S = 1.0
_AT_ONCE = 100
"""Hostile messages between two looks at what is heard."""
_MATERIAL_S = 1.0
"""So long before each burst everything that is said is kept as material."""
_MESSAGES_PER_S = 2000.0
"""Faster ones would be dropped by our own session, and not reach the router."""
_MARGIN_S = 600.0


@dataclass(frozen=True, slots=True)
class SiegeOptions:
    """How a swarm is besieged.

    scenario  a file or a built-in name
    seconds   the siege ends after so long; None: with the messages
    messages  the siege ends with so many hostile messages; None: with the seconds
    every_s   from one blow to the next, at least
    kinds     which blows
    hostile   which hostile messages
    spared    topics under which nothing hostile is said
    within_s  a blow from which the swarm recovers later breaks a law
    """

    scenario: str
    seconds: float | None
    messages: int | None
    seed: int = 1
    every_s: float = 10.0
    kinds: tuple[str, ...] = BLOWS
    hostile: tuple[str, ...] = KINDS
    spared: tuple[str, ...] = ()
    within_s: float = 10.0
    runs: Path = Path("runs")


class Siege:
    """One siege. `run` returns what it came to, and leaves no process behind, whatever happens."""

    def __init__(self, options: SiegeOptions, tell: Callable[[str], None]) -> None:
        self._options = options
        self._tell = tell
        scenario = with_port(find_scenario(options.scenario), 0)
        self._scenario: Scenario = scenario
        terrain = build_terrain(scenario)
        self._referee = Referee(
            class_truths(scenario, terrain, build_truth(scenario, terrain)), terrain.grid, aloft_classes(scenario)
        )
        vehicles = [id for plan in plan_agents(scenario) for id in plan.vehicle_ids]
        self._recovery = Recovery(vehicles)
        self._names = [spec.name for spec in processes_of(scenario)]
        names = (*NAMES, *scenario.target_ids, *(plan.id for plan in plan_agents(scenario)), *vehicles)
        classes = [each.name for each in scenario.classes]
        lies = Lies(terrain.grid, options.seed, tuple(dict.fromkeys(names)), classes)
        namespace = scenario.network.namespace
        self._hostile = Hostile(namespace, lies, options.seed, options.hostile, options.spared)
        self.run_dir = make_run_dir(options.runs, f"chaos-{time.strftime('%Y%m%d-%H%M%S')}-{options.seed}")
        self.tally = Tally(scenario=options.scenario, seed=options.seed, within_s=options.within_s)
        self._began_s = time.monotonic()
        self._pids: dict[str, int] = {}
        self._killed: set[int] = set()
        self._stopped: set[int] = set()
        self._scan_due_s = self._sample_due_s = 0.0

    @property
    def _now_s(self) -> float:
        """Seconds since the siege began."""
        return time.monotonic() - self._began_s

    def run(self) -> Tally:
        """Besiege to the end. Raises SwarmError if the swarm does not come up."""
        with self._swarm() as launcher:
            stranger = self._join(launcher)
            try:
                self._began_s = time.monotonic()
                self._scan_due_s = self._sample_due_s = 0.0
                self._besiege(launcher, stranger)
            finally:
                self.tally.seconds = self._now_s
                for pid in self._stopped:
                    _send(pid, signal.SIGCONT)
                stranger.close()
        return self.tally

    # --- the swarm ------------------------------------------------------------------------------------------

    @contextlib.contextmanager
    def _swarm(self) -> Iterator[UpProcess]:
        """`swarm up`; ends it, and all that it started."""
        port = self._scenario.network.connect[0].rpartition(":")[2]
        limit_s = (self._options.seconds or _LONGEST_S) + _MARGIN_S
        launcher = UpProcess(self._options.scenario, self.run_dir, limit_s, "--port", port, "--no-live")
        try:
            yield launcher
        finally:
            self.tally.left_behind += launcher.end()

    def _join(self, launcher: UpProcess) -> Stranger:
        """Wait until the swarm is up and every vehicle has been heard of."""
        began_s = time.monotonic()
        stranger: Stranger | None = None
        try:
            while time.monotonic() < began_s + _UP_WITHIN_S:
                launcher.check()
                if stranger is None:
                    if listening(self._scenario.network.connect[0]):
                        stranger = Stranger(self._scenario.network)
                    else:
                        time.sleep(0.2)
                    continue
                self._listen(stranger, 0.5)
                if self._recovery.reported and len(self._pids) >= len(self._names):
                    self._tell(f"up after {time.monotonic() - began_s:.1f} s; settling {_SETTLE_S:g} s")
                    self._listen(stranger, _SETTLE_S)
                    return stranger
            raise BusError(f"the swarm did not come up within {_UP_WITHIN_S:g} s; see {self.run_dir}")
        except BaseException:
            if stranger is not None:
                stranger.close()
            raise

    # --- blows ----------------------------------------------------------------------------------------------

    def _besiege(self, launcher: UpProcess, stranger: Stranger) -> None:
        options = self._options
        for number, blow in enumerate(blows(options.seed, self._names, options.kinds, options.every_s / 2)):
            if self._finished():
                return
            if (code := launcher.process.poll()) is not None:
                self.tally.ended.append(Ended(at_s=self._now_s, name="launcher", reason=f"exit code {code}"))
                return
            began_s = self._now_s
            outcome = self._strike(stranger, blow)
            self.tally.outcomes.append(outcome)
            self._tell(f"{number} {_sentence(outcome)}")
            self._listen(stranger, max(began_s + options.every_s - self._now_s, 0.5))

    def _finished(self) -> bool:
        options = self._options
        told = sum(self.tally.messages.values())
        return (options.seconds is not None and self._now_s >= options.seconds) or (
            options.messages is not None and told >= options.messages
        )

    def _strike(self, stranger: Stranger, blow: Blow) -> Outcome:
        at_s = from_s = self._now_s
        many, back_s = 0, 0.0
        match blow.kind:
            case "kill":
                back_s = self._kill(stranger, blow.whom)
            case "hang":
                self._hang(stranger, blow)
                from_s = self._now_s
            case "messages":
                many = self._burst(stranger, blow.lasts_s)
                from_s = self._now_s
        recovery = self._recovery
        recovery.over(self._now_s)
        until_s = self._now_s + _WATCH_S
        while self._now_s < until_s and (recovery.routed_s() is None or recovery.moving_s() is None):
            self._listen(stranger, 0.05)
        routed_s, moving_s = recovery.routed_s(), recovery.moving_s()
        return Outcome(
            at_s=at_s,
            kind=blow.kind,
            whom=blow.whom,
            lasts_s=blow.lasts_s,
            messages=many,
            back_s=back_s,
            routed_s=None if routed_s is None else routed_s - from_s,
            moving_s=None if moving_s is None else moving_s - from_s,
            late=tuple(recovery.unrouted() or recovery.standing()),
        )

    def _kill(self, stranger: Stranger, names: tuple[str, ...]) -> float:
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
            self._listen(stranger, 0.05)
            self._scan()
        return self._now_s - began_s

    def _hang(self, stranger: Stranger, blow: Blow) -> None:
        self._scan()
        pids = [self._pids[name] for name in blow.whom if name in self._pids]
        self._stopped.update(pids)
        for pid in pids:
            _send(pid, signal.SIGSTOP)
        self._listen(stranger, blow.lasts_s)
        for pid in pids:
            _send(pid, signal.SIGCONT)
        self._stopped.clear()

    def _burst(self, stranger: Stranger, lasts_s: float) -> int:
        with stranger.listening_to_all() as last:
            self._listen(stranger, _MATERIAL_S)
        for key, sample in sorted(last.items()):
            code = None if sample.attachment is None else sample.attachment.to_bytes()
            self._hostile.heard(key, sample.payload.to_bytes(), code)
        began_s, many = self._now_s, 0
        while self._now_s < began_s + lasts_s and not self._finished():
            for _ in range(_AT_ONCE):
                kind, key, payload, code = self._hostile.next()
                stranger.say(key, payload, code)
                self.tally.messages[kind] = self.tally.messages.get(kind, 0) + 1
                many += 1
            self._listen(stranger, max(began_s + many / _MESSAGES_PER_S - self._now_s, 0.0))
        return many

    # --- watching -------------------------------------------------------------------------------------------

    def _listen(self, stranger: Stranger, seconds: float) -> None:
        """Take in what is said for so long; look at the processes when it is time."""
        until_s = self._now_s + seconds
        while True:
            for payload in stranger.reports(min(max(until_s - self._now_s, 0.0), 0.05)):
                self._hear(payload)
            now_s = self._now_s
            if now_s >= self._scan_due_s:
                self._scan_due_s = now_s + _SCAN_S
                self._scan()
            if now_s >= self._sample_due_s:
                self._sample_due_s = now_s + _SAMPLE_S
                self._sample()
            if now_s >= until_s:
                return

    def _hear(self, payload: bytes) -> None:
        with contextlib.suppress(ProtocolError):
            fleet = decode(payload, FLEET.message)
            self._recovery.hear(fleet, self._now_s)  # type: ignore[arg-type]
            for broken in self._referee.hear(fleet):  # type: ignore[arg-type]
                if isinstance(broken, Collision):
                    text = f"{broken.first} and {broken.second} on cell {broken.cell} at {self._now_s:.1f} s"
                    self.tally.collisions.append(text)
                else:
                    self.tally.lethal_entries.append(
                        f"{broken.vehicle} on cell {broken.cell} at {self._now_s:.1f} s"
                    )

    def _scan(self) -> None:
        """Who runs now; who has ended without being killed."""
        gone = [(name, pid) for name, pid in self._pids.items() if has_ended(pid)]
        for name, pid in gone:
            del self._pids[name]
            if pid not in self._killed:
                self.tally.ended.append(Ended(at_s=self._now_s, name=name, reason=self._reason(name)))
                self._tell(f"{name} ended by itself at {self._now_s:.1f} s")
        # To search costs more than all else here, so only what is missing is searched for.
        if len(self._pids) < len(self._names):
            self._pids.update(processes(self.run_dir))

    def _reason(self, name: str) -> str:
        """What the launcher said of it last."""
        with contextlib.suppress(OSError):
            lines = (self.run_dir / "up.log").read_text(errors="replace").splitlines()
            return next((line[:300] for line in reversed(lines) if line.startswith(f"{name}: ")), "without a word")
        return "without a word"

    def _sample(self) -> None:
        some = [used for name in self._names if (used := self._used(name)) is not None]
        if len(some) == len(self._names):
            self.tally.samples.append(
                Sample(
                    at_s=self._now_s,
                    rss_mb=sum(each.rss_bytes for each in some) / 1e6,
                    threads=sum(each.threads for each in some),
                    files=sum(each.files for each in some),
                )
            )

    def _used(self, name: str) -> Usage | None:
        return usage(self._pids[name]) if name in self._pids else None


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
