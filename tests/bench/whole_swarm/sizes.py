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
power               exponent of the power of the number of vehicles that fits best
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import msgspec
import numpy as np
import typer

from bench.harness import benchmark, figure, numbers_of, tell
from bench.whole_swarm.live import measure_live
from bench.whole_swarm.simulated import measure_simulated
from bench.whole_swarm.size import Size, size_of
from swarm.errors import ConfigError, SwarmError

SERIES = (100, 300, 1000, 3000, 10_000)
MOST_LATE_SHARE = 0.1
"""The rates of a run whose agents are later than this say little: it does less than it should."""


@dataclass(frozen=True, slots=True)
class Figure:
    """One row of the table.

    key     where it is in the figures of a run: `cpu_ms_per_s.agent` is in a dictionary
    times   what it is multiplied by to be shown
    fitted  whether it grows by a power of the number of vehicles
    """

    key: str
    label: str
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
    Figure("cpu_all_ms_per_s", "CPU of all, ms/s", 1, True),
    *(
        Figure(f"cpu_ms_per_s.{role}", f"  {role}", 1, True)
        for role in ("agent", "planner", "router", "monitor", "launcher", "targets", "keeper")
    ),
    Figure("cpu_others_ms_per_s", "CPU of other work, ms/s"),
    Figure("cpu_agents_per_vehicle_ms_per_s", "CPU a vehicle, agents, ms/s"),
    Figure("cpu_all_per_vehicle_ms_per_s", "CPU a vehicle, all roles, ms/s"),
    Figure("cpu_planners_per_target_ms_per_s", "CPU a target, planners, ms/s"),
    Figure("messages_out_per_s", "messages sent, 1/s", 1, True),
    Figure("messages_in_per_s", "messages delivered, 1/s", 1, True),
    Figure("bytes_out_per_s", "sent, kB/s", 1e-3, True),
    Figure("bytes_in_per_s", "delivered, kB/s", 1e-3, True),
    Figure("route.ours_p50_us", "a route query, p50, ms", 1e-3),
    Figure("route.ours_p99_us", "  p99, ms", 1e-3),
    Figure("route.ratio_p50_us", "  over a raw get, p50"),
    Figure("route.ratio_p99_us", "  over a raw get, p99"),
    Figure("agents_route_query_p50_ms", "  as agents time it, p50, ms"),
    Figure("pss_mb_all", "memory of all, MB", 1, True),
    *(Figure(f"pss_mb.{role}", f"  {role}", 1, True) for role in ("agent", "planner", "monitor")),
    Figure("captures_per_min", "captures a minute"),
    Figure("restarts", "processes started again"),
    Figure("collisions", "collisions"),
    Figure("lethal_entries", "lethal cells entered"),
)
SIMULATED = (
    Figure("simulated_s", "simulated seconds measured"),
    Figure("times_real_time_of_cpu", "times real time, by CPU"),
    Figure("times_real_time", "times real time, by the clock"),
    Figure("cpu_all_ms_per_s", "CPU, ms per simulated second", 1, True),
    Figure("cpu_all_per_vehicle_ms_per_s", "CPU a vehicle, ms/s"),
    Figure("deliveries_per_s", "messages delivered, 1/s", 1, True),
    Figure("bytes_in_per_s", "delivered, kB/s", 1e-3, True),
    Figure("peak_mb", "memory at its peak, MB", 1, True),
    Figure("routed_share", "vehicles with a route, %", 100),
    Figure("captures", "captures"),
    Figure("collisions", "collisions"),
    Figure("lethal_entries", "lethal cells entered"),
)


@benchmark(fails=("broken",))
def swarm(
    vehicles: Annotated[str, typer.Option(help="Numbers of vehicles, several with commas.")] = "1000",
    series: Annotated[bool, typer.Option("--series", help="As --vehicles 100,300,1000,3000,10000.")] = False,
    targets: Annotated[int, typer.Option(help="Targets, and as many planners.")] = 10,
    agents: Annotated[
        int | None,
        typer.Option(help="Processes that host the vehicles.", show_default="one for 500 vehicles, 5 to 40"),
    ] = None,
    per_agent: Annotated[int | None, typer.Option(help="Vehicles of an agent, instead of --agents.")] = None,
    size: Annotated[
        int | None, typer.Option(help="Cells a side.", show_default="262 cells for each vehicle")
    ] = None,
    tick_hz: Annotated[float, typer.Option(help="Ticks a second of agents and planners.")] = 5.0,
    time_scale: Annotated[
        float,
        typer.Option(min=1e-3, max=100, help="Seconds on the terrain per second; 0.001 for a swarm at rest."),
    ] = 2.0,
    seconds: Annotated[
        float | None,
        typer.Option(min=1, max=3600, help="How long to measure.", show_default="30, simulated 10"),
    ] = None,
    simulated: Annotated[bool, typer.Option("--simulated", help="One process on a manual clock.")] = False,
    seed: Annotated[int, typer.Option(min=0, max=2**53, help="Seed of everything random.")] = 5,
) -> dict[str, Any]:
    """The cost of a swarm: lateness, CPU, messages, memory, start-up, latency of routes, by number of vehicles.

    \b
    ./launch_scripts/bench swarm --vehicles 1000
    ./launch_scripts/bench swarm --series --write sizes.md
    ./launch_scripts/bench swarm --vehicles 100,200,400,1000 --per-agent 25 --simulated
    bench swarm --vehicles 1000 --time-scale 0.001 --simulated     # what is told though nothing changes

    Starts the processes of `swarm up` on a free port of this machine, waits until every vehicle has a route,
    measures, and ends them: the scenario is `thousand` with a map that grows with the vehicles. With several sizes
    one after the other, and the power of the number of vehicles by which each figure grows. With --simulated the
    same swarm in one process; each size gets 90 seconds of CPU at most. The head of
    tests/bench/whole_swarm/sizes.py says what the rows mean.

    Exit code 1 if vehicles met or entered lethal cells, or a size could not be measured.
    """
    if series and vehicles != "1000":
        raise ConfigError(f"--series is --vehicles {','.join(map(str, SERIES))}: give one of the two")
    sizes = [
        size_of(
            *(each, targets),
            agents=agents,
            per_agent=per_agent,
            side=size,
            tick_hz=tick_hz,
            seed=seed,
            time_scale=time_scale,
        )
        for each in (SERIES if series else numbers_of(vehicles, "vehicles"))
    ]
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
    report["exponents"] = exponents([*kinds, *topics], [row for row in rows if "failed" not in row])
    report["mode"] = "simulation" if simulated else "live processes"
    plain = [Figure("agents", "agents"), Figure("side", "cells a side")]
    report["shown"] = {
        f"{sizes[0].targets} targets, ticks of {sizes[0].tick_hz:g} Hz, {seconds:g} s measured": lines_of(
            report, [*plain, *kinds]
        ),
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
    """A row for each figure: a value for each size, and the exponent where there are several."""
    rows = report["rows"]
    lines = []
    for each in figures:
        line = {"vehicles": each.label.replace("  ", "- ")}
        line |= {f"{row['vehicles']:,}": "-" if "failed" in row else each.shown(row) for row in rows}
        if len(rows) > 1:
            fitted = report["exponents"].get(each.key)
            line["power"] = "" if fitted is None else f"{fitted:.2f}"
        lines.append(line)
    return lines


def remarks(report: dict[str, Any]) -> list[str]:
    """Remarks that explain the figures: missing values with their reasons, and the rows behind each exponent."""
    rows = report["rows"]
    found = []
    for row in rows:
        found += [f"{row['vehicles']:,} vehicles: not measured: {each}." for each in row.get("not_measured", ())]
    late = [row for row in rows if "failed" not in row and not keeps_pace(row)]
    if late and len(rows) > 1:
        sizes = " and ".join(f"{row['vehicles']:,}" for row in late)
        found.append(
            f"Powers are fitted without {sizes} vehicles, where agents are late in more than "
            f"{100 * MOST_LATE_SHARE:g} % of their ticks: their rates are those of a swarm that does less than it "
            "should."
        )
    return found + [f"{each}." for each in broken(report)]


def topic_figures(rows: Sequence[dict[str, Any]]) -> list[Figure]:
    """Delivered bytes of each topic that any run delivered, the largest first."""
    topics: dict[str, float] = {}
    for row in rows:
        for topic, found in row.get("topics", {}).items():
            topics[topic] = max(found["bytes_per_s"], topics.get(topic, 0.0))
    largest = sorted(topics, key=lambda topic: -topics[topic])
    return [Figure(f"topics.{topic}.bytes_per_s", topic, 1e-3, True) for topic in largest]


def exponent(xs: Sequence[float], ys: Sequence[float | None]) -> float | None:
    """b of the power law a x^b that fits best, by least squares of the logarithms. None without two values above 0
    at different x."""
    points = [(x, y) for x, y in zip(xs, ys, strict=True) if y is not None and y > 0 and math.isfinite(y)]
    if len({x for x, _ in points}) < 2:
        return None
    along, values = np.log(np.array(points, np.float64)).T
    return float(np.polyfit(along, values, 1)[0])


def keeps_pace(row: dict[str, Any]) -> bool:
    """True if a run keeps up with time, which makes its rates meaningful."""
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
