"""Who sends what to whom in a swarm of one size, counted in a simulation: exact, the same on every machine.

python -m bench.scaling.traffic SIZE WARM_UP_S SECONDS LIMIT_S      prints one JSON object
"""

from __future__ import annotations

import json
import signal
import sys
from collections import Counter
from collections.abc import Sequence
from typing import Any

import msgspec

from bench.isolated import TimeLimit, measure
from bench.whole_swarm.size import Size, scenario_of
from launch_scripts.parent_death import end_with_parent
from launch_scripts.simulation.faults import OBSERVER
from swarm.runtime.garbage import collected_rarely

WARM_UP_S = 5.0
"""Simulated seconds before the measured ones. By then all have joined, and most vehicles have a route."""
LIMIT_S = 400.0
"""Seconds of CPU for a measurement; one that is not done by then is not used."""
MACHINES = (2, 4, 8)
"""Numbers of machines for which messages between machines are counted."""
_STEP_S = 0.5


def count_traffic(size: Size, warm_up_s: float, seconds: float, limit_s: float = LIMIT_S) -> dict[str, Any]:
    """Count in a process of its own. Raises SwarmError if it fails."""
    words = msgspec.json.encode(size).decode(), f"{warm_up_s:g}", f"{seconds:g}", f"{limit_s:g}"
    return measure(__name__, *words)


class Traffic:
    """Counts what is delivered, from the calls of a simulated network's trace. Pure.

    agents, targets  of the scenario: they decide on which machine a process runs
    """

    def __init__(self, agents: int, targets: int) -> None:
        self._agents, self._targets = agents, targets
        self._put: dict[int, tuple[str, str, bytes, set[str]]] = {}
        """Puts since the last `close`, by the identity of their payload: topic, sender, payload, who took it."""
        self.flows: Counter[tuple[str, str, str]] = Counter()
        """(topic, role that sends, role that takes) -> messages delivered."""
        self.flow_bytes: Counter[tuple[str, str, str]] = Counter()
        self.puts: Counter[tuple[str, str]] = Counter()
        """(topic, role that sends) -> messages that somebody took."""
        self.put_bytes: Counter[tuple[str, str]] = Counter()
        self.crossings: dict[int, Counter[str]] = {machines: Counter() for machines in MACHINES}
        """Machines -> topic -> messages from one machine to another, once for each machine that takes it."""
        self.crossing_bytes: dict[int, Counter[str]] = {machines: Counter() for machines in MACHINES}

    def delivered(self, now_ns: int, source: str, destination: str, topic: str, payload: bytes) -> None:
        """A trace of `MemoryNetwork`."""
        if not payload:
            return  # the end of a query, which is no message of its own
        known = self._put.get(id(payload))
        if known is None or known[0] != topic or known[1] != source:
            known = self._put[id(payload)] = (topic, source, payload, set())
        known[3].add(destination)
        flow = topic, role_of(source), role_of(destination)
        self.flows[flow] += 1
        self.flow_bytes[flow] += len(payload)

    def close(self) -> None:
        """Book the puts so far. A put of which a copy is under way now counts twice, once before and once after:
        call it seldom."""
        for topic, source, payload, takers in self._put.values():
            sent = topic, role_of(source)
            self.puts[sent] += 1
            self.put_bytes[sent] += len(payload)
            for machines in MACHINES:
                there = {self._machine(taker, machines) for taker in takers} - {self._machine(source, machines)}
                self.crossings[machines][topic] += len(there)
                self.crossing_bytes[machines][topic] += len(there) * len(payload)
        self._put.clear()

    def _machine(self, node: str, machines: int) -> int:
        """Agents and planners go to machines in blocks of equal size, all else to the first. Agents are numbered by
        place, so a machine's vehicles start in one part of the map."""
        role, _, id = node.partition("-")
        if role == "agent":
            return int(id[1:]) * machines // self._agents
        if role == "planner":
            return int(id[1:]) * machines // self._targets
        return 0


def role_of(node: str) -> str:
    """The role of a simulated node; what only listens stands for the launcher."""
    return "launcher" if node == OBSERVER else node.partition("-")[0]


def run(size: Size, warm_up_s: float, seconds: float, limit_s: float) -> dict[str, Any]:
    from launch_scripts.simulation.simulate import Simulation

    simulation = Simulation(scenario_of(size))
    traffic = Traffic(size.agents, size.targets)
    limit = TimeLimit(limit_s)

    def run_until(until_s: float) -> None:
        while simulation.now_s < until_s and not limit.is_up:
            simulation.run_until(min(simulation.now_s + _STEP_S, until_s))

    with collected_rarely():
        simulation.network.trace = None
        run_until(warm_up_s)
        simulation.network.trace = traffic.delivered
        from_s = simulation.now_s
        captures = simulation.report(from_s)["captures"]
        run_until(warm_up_s + seconds)
    traffic.close()
    passed_s = simulation.now_s - from_s
    return {
        "simulated_s": passed_s,
        "complete": passed_s > seconds - 1e-6,
        "captures_per_s": (simulation.report(simulation.now_s)["captures"] - captures) / passed_s
        if passed_s
        else None,
        "flows": _rates(traffic.flows, traffic.flow_bytes, ("topic", "source", "to"), passed_s),
        "puts": _rates(traffic.puts, traffic.put_bytes, ("topic", "source"), passed_s),
        "crossings": {
            str(machines): {
                topic: [count / passed_s, traffic.crossing_bytes[machines][topic] / passed_s]
                for topic, count in sorted(traffic.crossings[machines].items())
            }
            for machines in MACHINES
        },
    }


def _rates(
    messages: Counter[Any], sizes: Counter[Any], names: Sequence[str], passed_s: float
) -> list[dict[str, Any]]:
    """Rows with the parts of the key by name, messages and bytes a second; none where no time has passed."""
    return [
        {
            **dict(zip(names, key, strict=True)),
            "messages_per_s": count / passed_s,
            "bytes_per_s": sizes[key] / passed_s,
        }
        for key, count in sorted(messages.items())
        if passed_s
    ]


if __name__ == "__main__":
    end_with_parent(signal.SIGKILL)
    words = sys.argv[2:5]
    found = run(msgspec.json.decode(sys.argv[1], type=Size), *map(float, words))
    json.dump(found, sys.stdout)
    sys.stdout.write("\n")
