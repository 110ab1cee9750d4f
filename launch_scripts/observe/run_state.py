"""State of a run at an instant: the one source of all displays of a run, and the table of facts. Pure.

Every display of a fact takes its label, its text and its unit from the table, so that it reads the same
everywhere.
"""

from __future__ import annotations

import math
import tomllib
from collections import Counter
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from launch_scripts.observe.alarms import Alarm, alarms_of, kind_of, starts
from launch_scripts.observe.latest_messages import LatestState, VehicleColumns
from launch_scripts.observe.summed_counts import CertifiedGap, certified_gap, gap_text, gaps_to, percent
from launch_scripts.plain_text import first_of, format_duration, number_of, plain
from swarm.clock import NS_PER_S
from swarm.config.explain import hints_of
from swarm.config.vehicle_classes import GROUND
from swarm.runtime.stats import CAPTURES_OF, LEARNED, MESSAGES_PER_S, RESTARTS
from swarm.wire.messages.orders import GoalState

NONE = "-"
"""Text for an unknown value."""
_LABELS = tomllib.loads(Path(__file__).with_name("reported.toml").read_text(encoding="utf-8"))
REPORTED: dict[str, str] = _LABELS["figures"]
SUMMED: dict[str, str] = _LABELS["summed"]
"""Figures of a finished run, and those which are summed over its groups: name in its report -> label."""


def count(value: float | None) -> str:
    """Returns text such as 12,345."""
    return NONE if value is None else f"{value:,.0f}"


def seconds(value: float | None) -> str:
    """Returns text such as 34 s, 19 min."""
    return NONE if value is None else format_duration(value)


def distance(value_m: float) -> str:
    """Returns text such as 480 m, 1.2 km."""
    return f"{value_m:.0f} m" if value_m < 999.5 else f"{value_m / 1000:.1f} km"


def duration(milliseconds: float | None) -> str:
    """Returns text such as 1.2 ms, 3.4 s."""
    if milliseconds is None:
        return NONE
    return f"{milliseconds:.1f} ms" if milliseconds < 999.95 else f"{milliseconds / 1000:.1f} s"


def of_all(value: tuple[int, int]) -> str:
    """Returns text such as 15 of 16."""
    return f"{value[0]:,} of {value[1]:,}"


def each(value: Mapping[str, int]) -> str:
    """Returns text such as 17 following, 1 arrived."""
    return ", ".join(f"{number:,} {name}" for name, number in value.items() if number) or "none"


def factors(value: Mapping[str, float]) -> str:
    """Returns text such as grass x 2.9, forest x 0.63."""
    return ", ".join(f"{name} x {factor:.2g}" for name, factor in value.items()) or "nothing"


def _until_started(vehicles: Sequence[str]) -> str:
    return f"{number_of(len(vehicles), 'vehicle')} ({first_of(vehicles)}), until swarm order vehicle start NAME"


def _mean_gap(value: CertifiedGap) -> str:
    return percent(value.mean)


@dataclass(frozen=True, slots=True)
class Fact:
    """Label and text of a field of a `RunState`, or of a `TargetLine`, of which it is a column.

    label     what people call it
    text      its value in words, where that is known
    always    whether every table of targets has the column; else `swarm status` alone
    is_total  it is the count of its name, summed over all processes
    name      of the field, in the report and for programs
    """

    label: str
    text: Callable[[Any], str]
    always: bool = True
    is_total: bool = False
    name: str = ""

    def format(self, state: RunState | TargetLine) -> str:
        """The fact in words, as people see it."""
        value = getattr(state, self.name)
        return NONE if value is None else self.text(value)

    def labelled(self, state: RunState) -> str:
        """The same after its label."""
        return f"{self.label} {self.format(state)}"


def total(label: str) -> Fact:
    """The fact of a field which is a count, summed over all processes."""
    return Fact(label, count, is_total=True)


@dataclass(frozen=True, slots=True)
class TargetLine:
    """One target at an instant. Columns of its table are `title` and the fields which have a `Fact`, the most
    important first: a narrow panel cuts off the end.

    planner_up  whether its planner or one of its standbys is as it should be
    starting    whether none of them has been seen yet, in the first seconds of a run
    rank        of the planner that leads; 0 unless a standby does
    following   vehicles of the swarm that go for it: where an external vehicle goes is not published
    nearest_m   distance of the nearest vehicle
    captures    how often it was caught
    gap         how far above the optimum the routes to it can be at most
    growths     how often its tree was grown or repaired
    growth_ms   CPU time of the last full search
    strategy    how its tree is kept
    pose_age_s  time since its last pose; None before the first
    lost        whether no tracker publishes it: the position is the last known one
    """

    id: str
    planner_up: bool
    rank: int
    following: Annotated[int, Fact("chased by", count)]
    nearest_m: Annotated[float | None, Fact("nearest", distance)]
    captures: Annotated[int, Fact("captures", count)]
    gap: Annotated[CertifiedGap | None, Fact("certified gap", _mean_gap)]
    growths: Annotated[int | None, Fact("re-plans", count)]
    growth_ms: Annotated[float | None, Fact("tree", duration)]
    routes_served: Annotated[int | None, Fact("served", count, always=False)]
    strategy: Annotated[str | None, Fact("strategy", str, always=False)]
    pose_age_s: Annotated[float | None, Fact("seen", seconds, always=False)]
    tracker: Annotated[str | None, Fact("tracker", str, always=False)]
    lost: bool
    starting: bool

    @property
    def title(self) -> str:
        """The id, and exceptional states of its tracker and its planner."""
        unusual = []
        if self.lost:
            unusual.append("lost" if self.pose_age_s is None else f"lost for {format_duration(self.pose_age_s)}")
        if not self.planner_up:
            unusual.append("planner starting" if self.starting else "planner down")
        elif self.rank:
            unusual.append(f"standby {self.rank}")
        return f"{self.id} ({', '.join(unusual)})" if unusual else self.id


@dataclass(frozen=True, slots=True)
class RunState:
    """A run at an instant. Every report has the fields which have a `Fact`; `LINES`, `IF_ANY` and `MUST_BE_ZERO`
    place them in the lines for people.

    elapsed_s           time since the run began, start-up included
    vehicles_driven     vehicles that an agent drives, and all of the run
    states              vehicles that are driven, by VehicleState
    classes             the same by class, "ground" first
    following           vehicles that have a target
    paused              vehicles which the order to pause stops; 0 if the run is not paused
    stopped             ids of vehicles which an order to them stops
    sent                vehicles that were sent to places, by the state of their goals
    external            ids of external vehicles and other obstacles which report their places now
    captures            how often targets were caught
    marks               marks that vehicles made since the last start of their agents
    reroute_requests    how often a vehicle's own route did not lead it on, so that it asked for another
    routes_served       routes that planners gave in answer to questions; those which they pushed come on top
    certified_gap       how far above the optimum the routes that vehicles began can be at most, as proven
                        (`CertifiedGap.fields`)
    learned             class of ground -> measured factor on its prior pace; only classes whose factor is not 1
    collisions          two vehicles on one cell; must be 0
    lethal_entries      vehicles on cells that are lethal in truth; must be 0
    driven_into         vehicles that drove into an obstacle which had said in time where it is; must be 0
    hit_by_obstacles    the obstacles' own fault
    processes_well      processes that are as they should be (alive, or ended because they were asked to), and all
                        that the run needs
    processes_ended     of these, processes that ended because they were asked to
    restarts            how often a process was started again
    messages_now_per_s  messages that all processes send now
    payloads_dropped    messages that were none of this swarm, or came under a key that is not their sender's
    crew                as `processes_well`, by role
    beside              processes that are alive and not needed: routers, monitors, agents of external vehicles
    goals               progress of the vehicles that were sent to places
    """

    elapsed_s: Annotated[float, Fact("time", seconds)]
    vehicles_driven: Annotated[tuple[int, int], Fact("vehicles", of_all)]
    states: Annotated[dict[str, int], Fact("of these", each)]
    classes: Annotated[dict[str, int], Fact("classes", each)]
    following: Annotated[int, Fact("assigned", count)]
    paused: Annotated[int, Fact("paused", "all {} vehicles and simulated targets, until swarm resume".format)]
    stopped: Annotated[tuple[str, ...], Fact("stopped", _until_started)]
    sent: Annotated[dict[str, int], Fact("sent to places", each)]
    external: Annotated[tuple[str, ...], Fact("external vehicles", first_of)]
    captures: Annotated[int | None, total("captures")]
    marks: Annotated[int | None, total("marks")]
    reroute_requests: Annotated[int | None, total("re-route requests")]
    routes_served: Annotated[int | None, total("routes served")]
    certified_gap: Annotated[dict[str, float | None], Fact("certified gap", gap_text)]
    learned: Annotated[dict[str, float], Fact("learned", factors)]
    collisions: Annotated[int | None, total("collisions")]
    lethal_entries: Annotated[int | None, total("lethal cells entered")]
    driven_into: Annotated[int | None, total("obstacles driven into")]
    hit_by_obstacles: Annotated[int | None, total("vehicles hit by obstacles")]
    processes_well: Annotated[tuple[int, int], Fact("needed processes", of_all)]
    processes_ended: Annotated[int, Fact("of these ended as asked", count)]
    restarts: Annotated[int, Fact("restarts", count)]
    messages_now_per_s: Annotated[float | None, Fact("messages/s", count)]
    payloads_dropped: Annotated[int | None, total("payloads dropped")]
    crew: dict[str, tuple[int, int]]
    beside: dict[str, int]
    targets: tuple[TargetLine, ...]
    alarms: tuple[Alarm, ...]
    orders: tuple[str, ...]
    goals: tuple[GoalState, ...]


def _facts_of(state: type) -> tuple[Fact, ...]:
    """The facts among the fields of a state, in their order."""
    notes = ((name, getattr(hint, "__metadata__", ())) for name, hint in hints_of(state).items())
    return tuple(replace(fact, name=name) for name, facts in notes for fact in facts)


FACTS, TARGET_FACTS = _facts_of(RunState), (Fact("target", str, name="title"), *_facts_of(TargetLine))
fact = {fact.name: fact for fact in FACTS}.__getitem__
"""A fact of a run by its name. Raises KeyError on a name that is none."""


def _by_class(ids: Collection[str], classes: Mapping[str, str]) -> dict[str, int]:
    counts = Counter(classes[id] for id in ids)
    return {name: counts[name] for name in sorted(counts, key=lambda name: (name != GROUND, name))}


def state_of(latest: LatestState, now_ns: int) -> RunState:
    """The run at a time."""
    targets = latest.plan.targets_now(latest.book)
    crew = latest.plan.crew_now(targets)
    needed = set(crew)
    vehicles = latest.driven(needed, now_ns)
    planned = max(latest.plan.vehicles, len(vehicles))
    well = [latest.fills(role, id) for role, id in crew]
    began_ns, goals = latest.began_ns, latest.goals()
    expected, alive = Counter(role for role, _ in crew), Counter[str]()
    for (role, _), is_well in zip(crew, well, strict=True):
        alive[role] += is_well
    return RunState(
        elapsed_s=0.0 if began_ns is None else max(now_ns - began_ns, 0) / NS_PER_S,
        targets=_lines(latest, targets, vehicles, now_ns),
        states=vehicles.count_states(),
        classes=_by_class(vehicles.ids, latest.classes()),
        vehicles_driven=(len(vehicles), planned),
        following=int(np.count_nonzero(vehicles.targets >= 0)),
        messages_now_per_s=latest.now_of(MESSAGES_PER_S),
        processes_well=(sum(well), len(crew)),
        processes_ended=sum(latest.has_ended(role, id) for role, id in crew),
        external=tuple(latest.external(now_ns)),
        restarts=round(latest.gauge(RESTARTS) or 0),
        crew={role: (alive[role], expected[role]) for role in expected},
        beside=dict(Counter(role for role, id in latest.up() if (role, id) not in needed)),
        certified_gap=certified_gap(latest).fields(),
        learned=_learned(latest),
        alarms=alarms_of(latest, targets, now_ns),
        orders=tuple(map(plain, latest.book.standing)),
        paused=planned if latest.book.paused else 0,
        stopped=tuple(each.name for each in latest.book if each.subject == "vehicle" and not each.off),
        sent=dict(Counter(goal.state for goal in goals)),
        goals=tuple(goals),
        **{fact.name: latest.total(fact.name) for fact in FACTS if fact.is_total},
    )


def _lines(
    latest: LatestState, targets: Sequence[str], vehicles: VehicleColumns, now_ns: int
) -> tuple[TargetLine, ...]:
    lost, poses = latest.lost(now_ns), latest.poses
    captures, gaps = latest.counts_by(CAPTURES_OF), gaps_to(latest)
    lines = []
    for id in targets:
        pose, status = poses.get(id), latest.planner_status(id)
        nearest_m = None
        if pose is not None and len(vehicles):
            east_m, south_m = latest.place_m(pose)
            nearest_m = float(np.hypot(vehicles.east_m - east_m, vehicles.south_m - south_m).min())
        lines.append(
            TargetLine(
                id=id,
                planner_up=latest.is_up("planner", id) or latest.is_well("planner", id),
                rank=latest.rank("planner", id),
                following=len(vehicles.chasing(id)),
                nearest_m=nearest_m,
                growths=latest.of_job("planner", id, "growths", "window_growths"),
                # It is 0 as long as no tree has been grown.
                growth_ms=None if status is None else status.growth_ms or None,
                captures=captures.get(id, 0),
                gap=gaps.get(id),
                pose_age_s=latest.pose_age_s(id, now_ns),
                lost=id in lost,
                routes_served=latest.of_job("planner", id, "routes_served"),
                strategy=None if status is None else status.strategy,
                tracker=None if status is None else status.tracker,
                starting=starts(latest, "planner", id, now_ns),
            )
        )
    return tuple(lines)


def _learned(latest: LatestState) -> dict[str, float]:
    """Learned factors, from the planner that has the most: planners of other groups may have received fewer."""
    factors = [
        {name.removeprefix(LEARNED): value for name, value in stats.gauges.items() if name.startswith(LEARNED)}
        for (role, _), stats in latest.newest().items()
        if role == "planner"
    ]
    return dict(sorted(max(factors, key=len, default={}).items()))


def table(state: RunState, *, always: bool = True) -> tuple[list[str], list[list[str]]]:
    """The labels of the columns that every table of targets has, or of the target and the others; and the rows."""
    columns = [column for column in TARGET_FACTS if column.always == always or column is TARGET_FACTS[0]]
    rows = [[column.format(line) for column in columns] for line in state.targets]
    return [column.label for column in columns], rows


LINES: tuple[tuple[str, ...], ...] = (
    ("vehicles_driven", "states", "following"),
    ("captures", "marks", "reroute_requests", "routes_served"),
    ("certified_gap",),
    ("processes_well", "restarts", "messages_now_per_s"),
)
"""Lines in which the facts of a run are set."""
IF_ANY = ("paused", "stopped", "learned", "sent", "external", "processes_ended")
"""Facts that have a line of their own, where there is anything to say."""
MUST_BE_ZERO = ("collisions", "lethal_entries", "driven_into", "hit_by_obstacles", "payloads_dropped")
"""Facts that are shown only where they are not 0."""


def measured(names: Iterable[str], state: RunState) -> list[str]:
    """Those of some facts whose value is known, after their labels."""
    return [fact(name).labelled(state) for name in names if fact(name).format(state) != NONE]


def lines(state: RunState) -> list[str]:
    """The facts of a run but its time, in lines for people: `label text` with two spaces between facts."""
    found = [line for names in LINES if (line := "  ".join(measured(names, state)))]
    if list(state.classes) not in ([], [GROUND]):
        found.insert(1, fact("classes").labelled(state))
    found += [fact(name).labelled(state) for name in IF_ANY if getattr(state, name)]
    if wrong := [fact(name).labelled(state) for name in MUST_BE_ZERO if getattr(state, name)]:
        found.append("  ".join(wrong))
    return found


_LISTED_SINGLY = 2
"""Beyond this number alarms of one kind share one line: on a slow machine every process is behind."""


def alarm_lines(state: RunState, most: int, *, over: bool = False) -> list[str]:
    """The alarms that last, the most serious first, in lines for people; then how many lines are left out.

    over  also closed alarms
    """
    return lines_of((alarm for alarm in state.alarms if over or alarm.lasts), most)


def lines_of(alarms: Iterable[Alarm], most: int) -> list[str]:
    """Alarms in lines for people, and how many lines are left out."""
    found = [line for line, _ in grouped(alarms)]
    return [*found[:most], f"... {len(found) - most} more"] if len(found) > most else found


def grouped(alarms: Iterable[Alarm]) -> list[tuple[str, list[str]]]:
    """Lines for people, and the lines that each sums up. Many alarms of a kind, all over or all not, are in one
    line; among its own lines, many alarms of one process are in one, too."""
    return [
        (line, [own for own, _ in _summed(of_kind, lambda alarm: alarm.about)] if len(of_kind) > 1 else [])
        for line, of_kind in _summed(alarms, lambda alarm: (alarm.kind, alarm.lasts))
    ]


def _summed(alarms: Iterable[Alarm], key: Callable[[Alarm], Hashable]) -> Iterator[tuple[str, list[Alarm]]]:
    """Returns lines and the alarms of each: many alarms of one key are in one line."""
    keys: dict[Hashable, list[Alarm]] = {}
    for alarm in alarms:
        keys.setdefault(key(alarm), []).append(alarm)
    for some in keys.values():
        if len(some) > _LISTED_SINGLY:
            yield together(some), some
        else:
            yield from ((each.line, [each]) for each in some)


def together(alarms: Sequence[Alarm]) -> str:
    """Many alarms of one kind in a line."""
    longest = max(alarms, key=lambda alarm: alarm.lasted_s or 0.0)
    names = list(dict.fromkeys(alarm.about for alarm in alarms))
    of_many = kind_of(longest.kind).of_many
    cause = f" ({of_many})" if of_many and len(names) > _LISTED_SINGLY else ""
    when = f"the longest {longest.when or 'now'}{cause}"
    return f"{longest.label}: {len(alarms):,} times, {first_of(names)}, {when}"


def for_report(state: RunState) -> dict[str, Any]:
    """Every fact by its name, for a report, and every alarm."""
    return {
        **{each.name: getattr(state, each.name) for each in FACTS},
        "alarms": [alarm.fields() for alarm in state.alarms],
    }


def left_behind(report: Mapping[str, Any]) -> list[str]:
    """Returns unfinished business of vehicles, in sentences without a full stop, from the report of a run."""
    vehicles, routed = report["vehicles"], report.get("vehicles_routed")
    found = (
        (report.get("lost"), "lost at the end"),
        (report.get("stranded"), "stranded at the end"),
        (0 if routed is None else vehicles - routed, "without any route"),
    )
    return [f"{count(number)} of {count(vehicles)} vehicles {words}" for number, words in found if number]


def verdict(report: Mapping[str, Any], failures: Sequence[str] = ()) -> str:
    """The outcome of a run: what it reached, and whether all went well or what did not, from its report.

    failures  what its launcher says of processes, in sentences without a full stop

    An overload comes first: it explains the other faults.
    """
    captures, collisions = report.get("captures"), report.get("collisions")
    reached = [f"{count(report.get('vehicles_routed') or 0)} of {count(report['vehicles'])} vehicles routed"]
    reached += [] if captures is None else [number_of(captures, "capture")]
    reached += [] if collisions is None else [number_of(collisions, "collision")]
    forbidden = [f"{fact(name).label} {count(report[name])}" for name in MUST_BE_ZERO[:-1] if report.get(name)]
    serious = [
        alarm["text"] + (f" for {format_duration(alarm['over_s'] - alarm['since_s'])}" if alarm["over_s"] else "")
        for alarm in report.get("alarms") or []
        if kind_of(alarm["kind"]).serious and (alarm["over_s"] is None or alarm["kind"] == "silent")
    ]
    late = (report.get("ticks_late") or 0) / (report.get("ticks") or math.inf)
    overload = [f"overloaded machine, {late:.0%} of ticks were late"] if late > _LATE_SHARE else []
    wrong = list(dict.fromkeys([*overload, *failures, *forbidden, *serious, *left_behind(report)]))
    more = f"; and {len(wrong) - _FAULTS} more" if len(wrong) > _FAULTS else ""
    restarts = report.get("restarts")
    well = f"{WELL}, with {number_of(restarts, 'restart')}." if restarts else f"{WELL}."
    how = f"Not all went well: {'; '.join(wrong[:_FAULTS])}{more}." if wrong else well
    return f"{', '.join(reached)}. {how}"


_FAULTS = 3
"""Most faults that a verdict names."""
_LATE_SHARE = 0.2
"""Share of late ticks from which on a run is overloaded, as in the alert `SwarmTicksLate`."""
WELL = "All went well"
