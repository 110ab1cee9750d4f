"""What is known of a run where another launcher records it: the processes of this machine, by what each says of
itself. Pure."""

from __future__ import annotations

from typing import Any

from rich.console import Console, Group
from rich.text import Text

from launch_scripts.launcher.tables import SHOWN_ALARMS, loads_table
from launch_scripts.observe.alarms import Alarm, alarms_of
from launch_scripts.observe.facts import lines_of
from launch_scripts.observe.latest_state import LatestState
from launch_scripts.observe.plan import RunPlan
from launch_scripts.observe.process_load import ProcessLoad, by_role
from launch_scripts.process_table import ROLES, TABLE, ProcessSpec
from swarm.grid import GridSpec
from swarm.liveness import Peer, job_of
from swarm.wire.messages import Message

_OTHER_LINES = 4
"""Of the table: title, empty line, labels, and the line of the prompt."""


class OwnPart:
    """The processes that a launcher has started, and who else is there.

    started_ns  when the run began
    """

    def __init__(self, grid: GridSpec, started_ns: int) -> None:
        self.observed = LatestState(RunPlan((), (), 0, started_ns), grid)
        self.own: frozenset[ProcessSpec] = frozenset()
        """Set by the owner whenever a process is added or dismissed."""

    def heard(self, message: Message, now_ns: int) -> None:
        """Take in what comes on the keys of these processes, and orders."""
        self.observed.heard(message, now_ns)

    def alive(self, peer: Peer, up: bool, now_ns: int) -> None:
        """A liveliness token rose or fell."""
        self.observed.alive(peer, up, now_ns)

    def up(self) -> list[tuple[str, str]]:
        """(role, id) of these processes that are alive."""
        own = self._keys()
        return [key for key in self.observed.up() if key in own]

    @property
    def well(self) -> str:
        """How many are alive, in words."""
        return f"{len(self.up())} of {len(self.own)}"

    def loads(self) -> list[ProcessLoad]:
        """What they take up, each that has told twice."""
        own = self._keys()
        return [line for line in self.observed.loads.lines(self.up()) if (line.role, line.id) in own]

    def alarms(self, now_ns: int) -> tuple[Alarm, ...]:
        """What went wrong with them or is told by them."""
        crew = tuple(sorted(key for key in self._keys() if TABLE[key[0]].is_needed))
        targets = tuple(dict.fromkeys(job_of(id) for role, id in crew if role == "planner"))
        plan = RunPlan(targets, crew, 0, self.observed.plan.started_ns)
        return alarms_of(self.observed, plan, targets, now_ns)

    def report(self, *, run_id: str, seconds: float, startup_s: float | None) -> dict[str, Any]:
        """For programs: these processes, and that all else is told by another launcher."""
        loads = self.observed.loads.lines(self.up())
        return {
            "run_id": run_id,
            "recorded": False,
            "seconds": seconds,
            "startup_s": startup_s,
            "restarts": sum(line.restarts for line in loads),
            "processes": [spec.name for spec in sorted(self.own, key=lambda spec: spec.name)],
        }

    def table(self, title: str, now_ns: int, console: Console) -> Group:
        """All of it: each process, or each role where the console has too few lines."""
        alarms, lines = self._alarm_lines(now_ns), self.loads()
        each = len(lines) <= console.height - len(alarms) - _OTHER_LINES
        table = loads_table(lines if each else by_role(lines, ROLES), each=each)
        return Group(Text(title, style="bold"), *(Text(line, style="red") for line in alarms), Text(), table)

    def line(self, title: str, now_ns: int) -> str:
        """The same in one line."""
        restarts = sum(line.restarts for line in self.loads())
        alarms = "".join(f"; {line}" for line in self._alarm_lines(now_ns))
        return f"{title}: processes {self.well}, restarts {restarts}{alarms}"

    def _alarm_lines(self, now_ns: int) -> list[str]:
        lasting = [alarm for alarm in self.alarms(now_ns) if alarm.lasts]
        return lines_of(lasting, self.observed.grid, SHOWN_ALARMS)

    def _keys(self) -> set[tuple[str, str]]:
        return {(spec.role, spec.id) for spec in self.own}
