"""Cost of a swarm by its number of vehicles, live or simulated: one size after the other.

up                  from the command until all processes are alive and a route was served
vehicle answered    from the command until every vehicle has a route, or was told that there is none
ticks late          taken later than half a period after they were due, or never
CPU of all          1,000 ms/s are one core; the processes that measure are not in it
CPU of other work   of the whole machine, the processes that measure included; it makes ticks late
sent, delivered     payloads only; delivered in a simulation is per simulated second
a route query       from the question of a client beside the swarm to the parsed answer, 20 times a second
over a raw get      a plain Zenoh get of as many bytes, in turn with it
memory of all       proportional set size: shared pages count for their share
times real time     simulated seconds over seconds of CPU
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import msgspec
import typer

from bench.harness import benchmark, figure, numbers_of, tell
from bench.whole_swarm.live import measure_live
from bench.whole_swarm.simulated import measure_simulated
from bench.whole_swarm.size import Size, size_of
from swarm.errors import SwarmError


@dataclass(frozen=True, slots=True)
class Figure:
    """One row of the table.

    key    where it is in the figures of a run: `cpu_ms_per_s.agent` is in a dictionary
    times  what it is multiplied by to be shown
    """

    key: str
    label: str
    times: float = 1.0

    def of(self, figures: dict[str, Any]) -> float | None:
        """The value in the figures of a run; None if it was not measured."""
        found: Any = figures
        for part in self.key.split("."):
            found = found.get(part) if isinstance(found, dict) else None
        return None if found is None else float(found)

    def shown(self, figures: dict[str, Any]) -> str:
        value = self.of(figures)
        return figure(None if value is None else value * self.times)


LIVE = (
    Figure("up_s", "up, s"),
    Figure("routed_s", "every vehicle answered, s"),
    Figure("ticks.agent.late_share", "agents' ticks late, %", 100),
    Figure("ticks.agent.worst_late_share", "  of the worst agent, %", 100),
    Figure("ticks.agent.dropped_share", "  never taken, %", 100),
    Figure("ticks.agent.p50_ms", "an agent's tick, p50, ms"),
    Figure("ticks.agent.p99_ms", "  p99, ms"),
    Figure("ticks.planner.late_share", "planners' ticks late, %", 100),
    Figure("cpu_all_ms_per_s", "CPU of all, ms/s"),
    *(
        Figure(f"cpu_ms_per_s.{role}", f"  {role}")
        for role in ("agent", "planner", "router", "monitor", "launcher", "targets", "keeper")
    ),
    Figure("cpu_others_ms_per_s", "CPU of other work, ms/s"),
    Figure("cpu_agents_per_vehicle_ms_per_s", "CPU a vehicle, agents, ms/s"),
    Figure("cpu_all_per_vehicle_ms_per_s", "CPU a vehicle, all roles, ms/s"),
    Figure("cpu_planners_per_target_ms_per_s", "CPU a target, planners, ms/s"),
    Figure("messages_out_per_s", "messages sent, 1/s"),
    Figure("messages_in_per_s", "messages delivered, 1/s"),
    Figure("bytes_out_per_s", "sent, kB/s", 1e-3),
    Figure("bytes_in_per_s", "delivered, kB/s", 1e-3),
    Figure("route.ours_p50_us", "a route query, p50, ms", 1e-3),
    Figure("route.ours_p99_us", "  p99, ms", 1e-3),
    Figure("route.ratio_p50_us", "  over a raw get, p50"),
    Figure("route.ratio_p99_us", "  over a raw get, p99"),
    Figure("agents_route_query_p50_ms", "  as agents time it, p50, ms"),
    Figure("pss_mb_all", "memory of all, MB"),
    *(Figure(f"pss_mb.{role}", f"  {role}") for role in ("agent", "planner", "monitor")),
    Figure("captures_per_min", "captures a minute"),
    Figure("restarts", "processes started again"),
    Figure("collisions", "collisions"),
    Figure("lethal_entries", "lethal cells entered"),
)
SIMULATED = (
    Figure("simulated_s", "simulated seconds measured"),
    Figure("times_real_time_of_cpu", "times real time, by CPU"),
    Figure("times_real_time", "times real time, by the clock"),
    Figure("cpu_all_ms_per_s", "CPU, ms per simulated second"),
    Figure("cpu_all_per_vehicle_ms_per_s", "CPU a vehicle, ms/s"),
    Figure("deliveries_per_s", "messages delivered, 1/s"),
    Figure("bytes_in_per_s", "delivered, kB/s", 1e-3),
    Figure("peak_mb", "memory at its peak, MB"),
    Figure("routed_share", "vehicles with a route, %", 100),
    Figure("captures", "captures"),
    Figure("collisions", "collisions"),
    Figure("lethal_entries", "lethal cells entered"),
)


@benchmark(fails=("broken",))
def swarm(
    vehicles: Annotated[str, typer.Option(help="Numbers of vehicles, several with commas.")] = "1000",
    targets: Annotated[int, typer.Option(help="Targets, and as many planners.")] = 10,
    size: Annotated[
        int | None, typer.Option(help="Cells a side.", show_default="262 cells for each vehicle")
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(min=1, max=3600, help="How long to measure.", show_default="30, simulated 10")
    ] = None,
    simulated: Annotated[bool, typer.Option("--simulated", help="One process on a manual clock.")] = False,
) -> dict[str, Any]:
    """The cost of a swarm: lateness, CPU, messages, memory, start-up, latency of routes, by number of vehicles.

    \b
    ./launch_scripts/bench swarm --vehicles 1000
    ./launch_scripts/bench swarm --vehicles 100,300,1000,3000 --simulated

    Starts the processes of `swarm up` on a free port of this machine, waits until every vehicle has a route,
    measures, and ends them: the scenario is `thousand` with a map that grows with the vehicles. With --simulated
    the same swarm in one process; each size gets 90 seconds of CPU at most. The head of
    tests/bench/whole_swarm/sizes.py says what the rows mean.

    Exit code 1 if vehicles met or entered lethal cells, or a size could not be measured.
    """
    sizes = [size_of(each, targets, size) for each in numbers_of(vehicles, "vehicles")]
    return run_sizes(sizes, seconds or (10.0 if simulated else 30.0), simulated)


def run_sizes(sizes: Sequence[Size], seconds: float, simulated: bool) -> dict[str, Any]:
    """Measures each size. One that cannot be measured says why, and the others go on; of a single one SwarmError is
    raised. An interrupt keeps the results so far."""
    rows: list[dict[str, Any]] = []
    report: dict[str, Any] = {"simulated": simulated, "seconds": seconds, "rows": rows, "interrupted": False}
    try:
        for size in sizes:
            tell(f"{size.vehicles:,} vehicles of {size.agents} agents, {size.side} x {size.side} cells")
            try:
                found = measure_simulated(size, seconds) if simulated else measure_live(size, seconds)
            except SwarmError as error:
                if len(sizes) == 1:
                    raise
                tell(f"not measured: {error}")
                found = {"failed": str(error)}
            rows.append({**msgspec.structs.asdict(size), **found})
    except KeyboardInterrupt:
        report["interrupted"] = True
        tell("interrupted: the figures are of the sizes that were measured")
    kinds = SIMULATED if simulated else LIVE
    topics = topic_figures(rows)
    report["mode"] = "simulation" if simulated else "live processes"
    plain = [Figure("agents", "agents"), Figure("side", "cells a side")]
    report["shown"] = {
        f"{sizes[0].targets} targets, {seconds:g} s measured": lines_of(report, [*plain, *kinds]),
        "delivered by topic, kB/s": lines_of(report, topics),
    }
    report["broken"] = broken(report)
    report["notes"] = remarks(report)
    return report


def broken(report: dict[str, Any]) -> list[str]:
    """Violations: vehicles that met, runs that failed or did not end in order."""
    found = ["interrupted"] if report["interrupted"] else []
    for row in report["rows"]:
        title = f"{row['vehicles']:,} vehicles: "
        if "failed" in row:
            found.append(f"{title}not measured: {row['failed']}")
            continue
        for name in ("collisions", "lethal_entries"):
            if row.get(name):
                found.append(f"{title}{row[name]} {name.replace('_', ' ')}")
        if row.get("exit_code"):
            found.append(f"{title}the launcher ended with code {row['exit_code']}: {row['last_words']}")
    return found


def lines_of(report: dict[str, Any], figures: Sequence[Figure]) -> list[dict[str, str]]:
    """A row for each figure: a value for each size."""
    rows = report["rows"]
    lines = []
    for each in figures:
        line = {"vehicles": each.label.replace("  ", "- ")}
        line |= {f"{row['vehicles']:,}": "-" if "failed" in row else each.shown(row) for row in rows}
        lines.append(line)
    return lines


def remarks(report: dict[str, Any]) -> list[str]:
    """Remarks that explain the figures: missing values with their reasons."""
    rows = report["rows"]
    found = []
    for row in rows:
        found += [f"{row['vehicles']:,} vehicles: not measured: {each}." for each in row.get("not_measured", ())]
    return found + [f"{each}." for each in broken(report)]


def topic_figures(rows: Sequence[dict[str, Any]]) -> list[Figure]:
    """Delivered bytes of each topic that any run delivered, the largest first."""
    topics: dict[str, float] = {}
    for row in rows:
        for topic, found in row.get("topics", {}).items():
            topics[topic] = max(found["bytes_per_s"], topics.get(topic, 0.0))
    largest = sorted(topics, key=lambda topic: -topics[topic])
    return [Figure(f"topics.{topic}.bytes_per_s", topic, 1e-3) for topic in largest]
