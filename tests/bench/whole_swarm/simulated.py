"""The same swarm in one process, on a memory bus and a manual clock."""

from __future__ import annotations

import resource
import signal
import time
from collections import Counter
from typing import Any

import msgspec

from bench.isolated import TimeLimit, isolated
from bench.whole_swarm.size import Size, scenario_of, size_of
from launch_scripts.parent_death import end_with_parent
from swarm.runtime.process import collected_rarely

WARM_UP_S = 1.0
"""Simulated seconds before the measured ones: all processes start in them."""
LIMIT_S = 90.0
"""Seconds of CPU for a measurement, after the terrain is made; the rest is left out."""
_LOADING_S = 4.0
_STEP_S = 0.1


def measure_simulated(size: Size, seconds: float, limit_s: float = LIMIT_S) -> dict[str, Any]:
    """Measures a simulation in a process of its own. Raises SwarmError if it fails."""
    found: dict[str, Any] = isolated(simulate, msgspec.structs.asdict(size), seconds, limit_s)
    return found


def simulate(fields: dict[str, Any], seconds: float, limit_s: float) -> dict[str, Any]:
    """Figures of a simulation of a size, given by its fields; ended with the process which asked for it."""
    from launch_scripts.simulation.simulate import Simulation

    end_with_parent(signal.SIGKILL)
    size = Size(**fields)
    # A small one first, in which kernels are loaded, or compiled.
    Simulation(scenario_of(size_of(20, 2))).run_until(_LOADING_S)
    began_s = time.perf_counter()
    simulation = Simulation(scenario_of(size))
    built_s = time.perf_counter() - began_s
    messages: Counter[str] = Counter()
    payloads: Counter[str] = Counter()
    limit = TimeLimit(limit_s)

    def deliver(now_ns: int, source: str, destination: str, topic: str, payload: bytes) -> None:
        messages[topic] += 1
        payloads[topic] += len(payload)

    def run_until(until_s: float) -> None:
        while simulation.now_s < until_s and not limit.is_up:
            simulation.run_until(min(simulation.now_s + _STEP_S, until_s))

    with collected_rarely():  # as `simulate` does
        run_until(WARM_UP_S)
        simulation.network.trace = deliver
        from_s, wall_s, cpu_s = simulation.now_s, time.perf_counter(), time.process_time()
        run_until(WARM_UP_S + seconds)
        passed_s = simulation.now_s - from_s
        cpu_s, wall_s = time.process_time() - cpu_s, time.perf_counter() - wall_s
    report = simulation.report(simulation.now_s)
    not_measured = []
    if passed_s < seconds - 1e-6:
        not_measured.append(
            f"{seconds - passed_s:.1f} of {seconds:g} simulated seconds: {limit_s:g} s of CPU were up"
        )
    return {
        "simulated_s": passed_s,
        "terrain_s": built_s,
        "times_real_time": passed_s / wall_s if passed_s else None,
        "times_real_time_of_cpu": passed_s / cpu_s if passed_s else None,
        "cpu_all_ms_per_s": 1000 * cpu_s / passed_s if passed_s else None,
        "cpu_all_per_vehicle_ms_per_s": 1000 * cpu_s / passed_s / size.vehicles if passed_s else None,
        "deliveries_per_s": messages.total() / passed_s if passed_s else None,
        "bytes_in_per_s": payloads.total() / passed_s if passed_s else None,
        "topics": {
            topic: {"deliveries_per_s": messages[topic] / passed_s, "bytes_per_s": size_bytes / passed_s}
            for topic, size_bytes in payloads.most_common()
            if passed_s
        },
        "routed_share": report["vehicles_routed"] / size.vehicles,
        **{name: report[name] for name in ("captures", "collisions", "lethal_entries")},
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000,
        "not_measured": not_measured,
    }
