"""The rows of figures about a swarm: what each says, how it is written, and which exponent it follows. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.tables import number

MOST_LATE_SHARE = 0.1
"""Of a run whose agents are later than this the rates say little: it does less than it should."""


@dataclass(frozen=True, slots=True)
class Figure:
    """One row.

    key      where it is in the figures of a run: `cpu_ms_per_s.agent` is in a dictionary
    meaning  a sentence for those who do not know the label; empty if the one before says it
    times    what it is multiplied by to be shown
    fitted   whether it grows by a power of the number of vehicles
    """

    key: str
    label: str
    meaning: str = ""
    times: float = 1.0
    fitted: bool = False

    def of(self, figures: dict[str, Any]) -> float | None:
        """The value in the figures of a run; None if it was not measured."""
        found: Any = figures
        for part in self.key.split("."):
            found = found.get(part) if isinstance(found, dict) else None
        return None if found is None else float(found)

    def shown(self, figures: dict[str, Any]) -> str:
        value = self.of(figures)
        if value is None:
            return "-"
        value *= self.times
        return f"{value:,.0f}" if value.is_integer() else number(value)


LIVE = (
    Figure("up_s", "up, s", "From the command until all processes are alive and a route was served."),
    Figure(
        "routed_s",
        "every vehicle answered, s",
        "From the command until every vehicle has a route, or was told that there is none.",
    ),
    Figure(
        "ticks.agent.late_share",
        "agents' ticks late, %",
        "Taken later than half a period after they were due, or never.",
        100,
    ),
    Figure("ticks.agent.worst_late_share", "  of the worst agent, %", "", 100),
    Figure("ticks.agent.dropped_share", "  never taken, %", "", 100),
    Figure("ticks.agent.p50_ms", "an agent's tick, p50, ms", "How long it takes, once it has begun."),
    Figure("ticks.agent.p99_ms", "  p99, ms"),
    Figure("ticks.planner.late_share", "planners' ticks late, %", "", 100),
    Figure(
        "cpu_all_ms_per_s",
        "CPU of all, ms/s",
        "1,000 is one core. What measures is not in it.",
        1,
        True,
    ),
    Figure("cpu_ms_per_s.agent", "  agents", "", 1, True),
    Figure("cpu_ms_per_s.planner", "  planners", "", 1, True),
    Figure("cpu_ms_per_s.router", "  router", "", 1, True),
    Figure("cpu_ms_per_s.monitor", "  monitor", "", 1, True),
    Figure("cpu_ms_per_s.launcher", "  launcher", "", 1, True),
    Figure("cpu_ms_per_s.targets", "  targets", "", 1, True),
    Figure("cpu_ms_per_s.keeper", "  keeper", "", 1, True),
    Figure(
        "cpu_others_ms_per_s",
        "CPU of other work, ms/s",
        "Of the whole machine, what measures included. Where it is not small, ticks are late because of it.",
    ),
    Figure("cpu_agents_per_vehicle_ms_per_s", "CPU a vehicle, agents, ms/s"),
    Figure("cpu_all_per_vehicle_ms_per_s", "CPU a vehicle, all roles, ms/s"),
    Figure("cpu_planners_per_target_ms_per_s", "CPU a target, planners, ms/s"),
    Figure("messages_out_per_s", "messages sent, 1/s", "By all processes, as they count them.", 1, True),
    Figure("messages_in_per_s", "messages delivered, 1/s", "", 1, True),
    Figure("bytes_out_per_s", "sent, kB/s", "Payloads only.", 1e-3, True),
    Figure("bytes_in_per_s", "delivered, kB/s", "", 1e-3, True),
    Figure(
        "route.ours_p50_us",
        "a route query, p50, ms",
        "From the question of a client beside the swarm to the parsed answer, twenty times a second.",
        1e-3,
    ),
    Figure("route.ours_p99_us", "  p99, ms", "", 1e-3),
    Figure("route.ratio_p50", "  over a raw get, p50", "A plain Zenoh get of as many bytes, in turn with it."),
    Figure("route.ratio_p99", "  over a raw get, p99"),
    Figure("agents_route_query_p50_ms", "  as agents time it, p50, ms"),
    Figure(
        "pss_mb_all", "memory of all, MB", "Proportional set size: shared pages count for their share.", 1, True
    ),
    Figure("pss_mb.agent", "  agents", "", 1, True),
    Figure("pss_mb.planner", "  planners", "", 1, True),
    Figure("pss_mb.monitor", "  monitor", "", 1, True),
    Figure("captures_per_min", "captures a minute", "Over the whole run."),
    Figure("restarts", "processes started again"),
    Figure("collisions", "collisions", "Over the whole run, by what agents report."),
    Figure("lethal_entries", "lethal cells entered"),
)

SIMULATED = (
    Figure("simulated_s", "simulated seconds measured", "After the first, in which all processes start."),
    Figure("times_real_time_of_cpu", "times real time, by CPU", "Simulated seconds over seconds of CPU."),
    Figure("times_real_time", "times real time, by the clock"),
    Figure("cpu_all_ms_per_s", "CPU, ms per simulated second", "", 1, True),
    Figure("cpu_all_per_vehicle_ms_per_s", "CPU a vehicle, ms/s"),
    Figure("deliveries_per_s", "messages delivered, 1/s", "Per simulated second, to all processes.", 1, True),
    Figure("bytes_in_per_s", "delivered, kB/s", "Payloads only.", 1e-3, True),
    Figure("peak_mb", "memory at its peak, MB", "Resident, of the one process.", 1, True),
    Figure("routed_share", "vehicles with a route, %", "At the end.", 100),
    Figure("captures", "captures"),
    Figure("collisions", "collisions", "Over the whole run, by what agents report."),
    Figure("lethal_entries", "lethal cells entered"),
)


def topic_figures(rows: Sequence[dict[str, Any]]) -> list[Figure]:
    """Delivered bytes of each topic that any run delivered, the largest first."""
    topics: dict[str, float] = {}
    for row in rows:
        for topic, found in row.get("topics", {}).items():
            topics[topic] = max(found["bytes_per_s"], topics.get(topic, 0.0))
    largest = sorted(topics, key=lambda topic: -topics[topic])
    return [Figure(f"topics.{topic}.bytes_per_s", topic, "", 1e-3, True) for topic in largest]


def exponent(xs: Sequence[float], ys: Sequence[float | None]) -> float | None:
    """b of the power law a x^b that fits best, by least squares of the logarithms. None without two values above 0
    at different x."""
    points = [(x, y) for x, y in zip(xs, ys, strict=True) if y is not None and y > 0 and math.isfinite(y)]
    if len({x for x, _ in points}) < 2:
        return None
    along, values = np.log(np.array(points, np.float64)).T
    return float(np.polyfit(along, values, 1)[0])


def keeps_pace(row: dict[str, Any]) -> bool:
    """Whether a run does what it should in a second, so that its rates say what that costs."""
    late = row.get("ticks", {}).get("agent", {}).get("late_share")
    return late is None or late <= MOST_LATE_SHARE


def exponents(figures: Sequence[Figure], rows: Sequence[dict[str, Any]]) -> dict[str, float | None]:
    """Key -> exponent over the vehicles, of the runs which keep pace."""
    kept = [row for row in rows if keeps_pace(row)]
    return {
        each.key: exponent([row["vehicles"] for row in kept], [each.of(row) for row in kept])
        for each in figures
        if each.fitted
    }
