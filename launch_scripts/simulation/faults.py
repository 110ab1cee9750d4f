"""Faults of a simulation: a plan made from a seed, and the links that follow it.

Nodes are named as processes are: "keeper-0", "planner-t3", "agent-a1". Times are seconds since the run began.
"""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from typing import NamedTuple

import msgspec

from launch_scripts.process_table import SIMULATED_ROLES, processes_of
from swarm.clock import NS_PER_S
from swarm.config.scenario import Scenario, plan_agents
from swarm.config.vehicle_classes import flies
from swarm.right_of_way.shards import FEWEST_FOR_MAJORITY

RELINK_S = 0.3
"""Seconds until a client has found its router again: the retry period, and a session's start."""
OBSERVER = "recorder-0"
"""The node that writes the report. No fault touches it, or the report would be wrong."""
_STEPS_S = (-3600.0, 3600.0, -36_000.0, 36_000.0, 5.0, -5.0)
"""Steps of a clock, one for each node. With its offset of an hour at most no clock is half a day off: marks of a
process whose clock is a day ahead of the reader's are refused, so one of two would never accept the other's."""
_STOPS_S = (0.02, 0.1, 0.4, 1.5, 3.0)
"""Longest stops of a process on a machine that is far too busy: from a slice of a scheduler to a page from disk."""
_NS_PER_MS = 1_000_000
"""A unit: plans of faults are written in milliseconds, the simulated clock counts nanoseconds."""


class Partition(msgspec.Struct, frozen=True):
    """Cuts these nodes off from all others for a while. Among themselves they stay connected.

    one_way  the others do not hear them, but they hear the others. After the lease a half-open session is closed.
             From then on the link is cut in both directions.
    """

    from_s: float
    until_s: float
    nodes: tuple[str, ...]
    one_way: bool = False


class Crash(msgspec.Struct, frozen=True):
    """Kills a process as kill -9 does. It starts again after a backoff, or never, as if its machine was lost."""

    at_s: float
    node: str
    for_good: bool = False


class Hang(msgspec.Struct, frozen=True):
    """Stops a process's loop for a while. Its session lives on, and messages wait meanwhile."""

    from_s: float
    until_s: float
    node: str


class ClockStep(msgspec.Struct, frozen=True):
    """Sets the clock of a process's machine. Seen by its next generation: a process reads the clock at its
    start."""

    at_s: float
    node: str
    by_s: float


class Twin(msgspec.Struct, frozen=True):
    """Starts a second generation of an agent on another machine, while the first may still run."""

    at_s: float
    node: str


class Stop(NamedTuple):
    """A stop of a process within a call of its service, for `lasts_ns`.

    A call of a service is four steps: its inbox is read, the clock is read, it works, and its messages go out one
    by one. Work reads nothing else, so a stop within it is one before a message.

    sends  the messages that go out before the stop; None: it is stopped earlier
    timed  the clock was read before the stop
    """

    lasts_ns: int
    sends: int | None
    timed: bool


class FaultPlan(msgspec.Struct, frozen=True):
    """All faults of one run.

    drop        share of messages that are lost
    duplicate   share that arrive twice
    reorder     share that later messages overtake
    delay_ms    delay of every message; up to jitter_ms more are added by chance
    stutter     share of calls of a service within which its process is stopped, see `Stop`
    quiet_s     from this second on no message is lost, repeated or reordered; None: never
    skews_ms    by how much each node's clock is wrong
    """

    drop: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0
    delay_ms: float = 0.2
    jitter_ms: float = 0.0
    stutter: float = 0.0
    quiet_s: float | None = None
    partitions: tuple[Partition, ...] = ()
    crashes: tuple[Crash, ...] = ()
    skews_ms: dict[str, float] = {}
    hangs: tuple[Hang, ...] = ()
    clock_steps: tuple[ClockStep, ...] = ()
    twins: tuple[Twin, ...] = ()

    def counts(self) -> dict[str, int]:
        """Returns the number of faults of each kind."""
        return {
            "crashes": len(self.crashes),
            "cuts": len(self.partitions),
            "one_way_cuts": sum(cut.one_way for cut in self.partitions),
            "hangs": len(self.hangs),
            "clock_steps": len(self.clock_steps),
            "second_generations": len(self.twins),
        }


class FaultyLinks:
    """The `LinkModel` of a plan. Messages from one node to another keep their order unless they are reordered."""

    def __init__(self, plan: FaultPlan, chance: random.Random, began_ns: int, lease_s: float) -> None:
        self._plan = plan
        self._chance = chance
        self._began_ns = began_ns
        self._lease_s = lease_s
        self._quiet_s = math.inf if plan.quiet_s is None else plan.quiet_s
        self._last_ns: dict[tuple[str, str], int] = {}
        self._held: dict[str, tuple[int, int]] = {}
        """Stopped node -> how many messages it sends before the stop, and until when that lasts."""
        faultless = not (
            plan.drop or plan.duplicate or plan.reorder or plan.jitter_ms or plan.partitions or plan.stutter
        )
        self._always = (int(plan.delay_ms * _NS_PER_MS),) if faultless else None

    def stop(self, now_ns: int) -> Stop | None:
        """Draws whether a process is stopped in a call that begins now, and where."""
        plan, chance = self._plan, self._chance
        if not plan.stutter or chance.random() >= plan.stutter or self._at_s(now_ns) >= self._quiet_s:
            return None
        lasts_ns = int(chance.choice(_STOPS_S) * chance.uniform(0.5, 1.0) * NS_PER_S)
        sends = chance.choice((None, chance.randrange(20)))
        return Stop(lasts_ns, sends, chance.random() < 0.5)

    def hold(self, node: str, sends: int, until_ns: int) -> None:
        """Holds messages of a node until a time, all but the next `sends`."""
        self._held[node] = sends, until_ns

    def _at_s(self, now_ns: int) -> float:
        """Seconds since the run began."""
        return (now_ns - self._began_ns) / NS_PER_S

    def _held_ns(self, source: str, now_ns: int) -> int:
        """Returns the time for which a message of a node waits for the end of its stop."""
        sends, until_ns = self._held.get(source, (0, 0))
        if sends and until_ns > now_ns:
            self._held[source] = sends - 1, until_ns
            return 0
        return max(until_ns - now_ns, 0)

    def delays_ns(self, source: str, destination: str, what: str, now_ns: int) -> Sequence[int]:
        if self._always is not None:
            return self._always
        plan, chance = self._plan, self._chance
        if OBSERVER in (source, destination):
            return (_NS_PER_MS,)
        at_s = self._at_s(now_ns)
        if any(
            _apart(each, source, destination) and self._cut(each, at_s, source in each.nodes)
            for each in plan.partitions
        ):
            return ()
        quiet = at_s >= self._quiet_s
        if not quiet and plan.drop and chance.random() < plan.drop:
            return ()
        delay_ns = int((plan.delay_ms + chance.random() * plan.jitter_ms) * _NS_PER_MS)
        delay_ns += self._held_ns(source, now_ns)
        if not quiet and plan.reorder and chance.random() < plan.reorder:
            return (delay_ns + int((1 + chance.random() * 99) * _NS_PER_MS),)
        link = (source, destination)
        arrival_ns = max(now_ns + delay_ns, self._last_ns.get(link, 0))
        self._last_ns[link] = arrival_ns
        if not quiet and plan.duplicate and chance.random() < plan.duplicate:
            return (arrival_ns - now_ns, arrival_ns - now_ns + int(chance.random() * 100 * _NS_PER_MS))
        return (arrival_ns - now_ns,)

    def connected(self, source: str, destination: str, now_ns: int) -> bool:
        at_s = self._at_s(now_ns)
        return not any(
            _apart(each, source, destination) and self.noticed(each)
            for each in self._plan.partitions
            if OBSERVER not in (source, destination)
            and each.from_s + self._lease_s <= at_s < each.until_s + RELINK_S
        )

    def any_cut(self, at_s: float) -> bool:
        """Returns True if any process is cut off at a time, in seconds since the run began."""
        return any(self._cut(each, at_s, outwards=True) for each in self._plan.partitions)

    def noticed(self, partition: Partition) -> bool:
        """Returns True if a partition outlasts the lease, so that sessions end and liveliness tokens fall."""
        return partition.until_s - partition.from_s > self._lease_s

    def _cut(self, partition: Partition, at_s: float, outwards: bool) -> bool:
        """Returns True if the link currently drops messages from the nodes (`outwards`), or to them."""
        back_s = partition.until_s + (RELINK_S if self.noticed(partition) else 0.0)
        half_open = partition.one_way and at_s < min(partition.from_s + self._lease_s, partition.until_s)
        return partition.from_s <= at_s < back_s and (outwards or not half_open)


def _apart(partition: Partition, source: str, destination: str) -> bool:
    return (source in partition.nodes) != (destination in partition.nodes)


def random_plan(scenario: Scenario, seed: int, seconds: float) -> FaultPlan:
    """Draws a plan for a run of a scenario: everything at once in the first three fifths, nothing in the rest.

    Returns random faults: crashes of any process; partitions, unnoticed, noticed and one-way; hangs; clock offsets
    and steps; second generations of agents; messages lost, late, repeated and out of order. A seed may leave any
    of them out, so that a failure shows what it needs.

    Agents with at most one other in their layer, on the ground or in the air, have no second generation elsewhere:
    a shard of theirs has one member, and it is unknown which of its files is the first.
    """
    chance = random.Random(f"faults/{seed}")
    names = sorted(spec.name for spec in processes_of(scenario, SIMULATED_ROLES))
    agents = [name for name in names if name.startswith("agent-")]
    quiet_s = seconds * 3 / 5

    def span(lasts_s: float) -> tuple[float, float]:
        from_s = chance.uniform(0.1, 0.7) * quiet_s
        return from_s, min(from_s + lasts_s, quiet_s)

    partitions, hangs, twins, clock_steps = [], [], [], {}
    for _ in range(chance.randrange(4)):
        cut_off = chance.sample(names, chance.randint(1, max(1, len(names) // 3)))
        one_way = chance.random() < 0.4
        partitions.append(Partition(*span(chance.choice((0.5, 2.0, 4.0))), tuple(sorted(cut_off)), one_way))
    crashes = [Crash(chance.uniform(0.1, 0.95) * quiet_s, chance.choice(names)) for _ in range(chance.randrange(7))]
    cut_off_at_start = random.Random(f"cut off at its start/{seed}")  # as beside a router that restarts with it
    for each in partitions:
        if cut_off_at_start.random() < 0.5:
            crashes.append(Crash(each.from_s, cut_off_at_start.choice(each.nodes)))
    for _ in range(chance.randrange(3)):
        hangs.append(Hang(*span(chance.choice((0.3, 1.5, 4.0))), chance.choice(names)))
    # With fewer than three agents no shard has a majority without the one that is cut off.
    if len(agents) >= 3 and chance.random() < 0.3:
        name = chance.choice(agents)
        from_s, until_s = span(4.0)
        partitions.append(Partition(from_s, until_s, (name,), chance.random() < 0.3))
        twin = Twin(chance.uniform(from_s, until_s), name)
        twins += [twin] if name not in few_of_layer(scenario) else []
    for crash in crashes:
        if chance.random() < 0.3:
            clock_steps[crash.node] = ClockStep(crash.at_s, crash.node, chance.choice(_STEPS_S))
    return FaultPlan(
        drop=chance.choice((0.0, 0.01, 0.1)),
        duplicate=chance.choice((0.0, 0.01, 0.1)),
        reorder=chance.choice((0.0, 0.01, 0.1)),
        delay_ms=chance.choice((0.2, 5.0, 20.0, 100.0)),
        jitter_ms=chance.choice((0.0, 1.0, 30.0)),
        quiet_s=quiet_s,
        partitions=tuple(partitions),
        crashes=tuple(sorted(crashes, key=lambda crash: (crash.at_s, crash.node))),
        skews_ms={
            node: chance.choice((200, 3.6e6)) * chance.uniform(-1, 1) for node in names if chance.random() < 0.3
        },
        hangs=tuple(hangs),
        twins=tuple(twins),
        clock_steps=tuple(clock_steps.values()),
    )


def few_of_layer(scenario: Scenario) -> list[str]:
    """The nodes of agents that are less than three on the ground, or in the air: each has its own right of way."""
    layers: dict[bool, list[str]] = {}
    for plan in plan_agents(scenario):
        layers.setdefault(flies(scenario, plan.group.vehicle_class), []).append(f"agent-{plan.id}")
    return [name for layer in layers.values() if len(layer) < FEWEST_FOR_MAJORITY for name in layer]
