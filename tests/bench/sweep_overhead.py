"""What `swarm sweep` costs beside a plain loop over the same trials in as many processes."""

from __future__ import annotations

import resource
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bench.machine import machine
from bench.tables import Progress
from launch_scripts.simulation.campaign import in_processes
from launch_scripts.simulation.study.run import Sweep
from launch_scripts.simulation.study.trial import run_trial

STUDY = """
name = "overhead"
scenarios = ["synthetic"]
seeds = "0:{trials}"
"""


def run(trials: int, processes: int, rounds: int, progress: Progress) -> dict[str, Any]:
    """Loop and sweep in turn, so that a load of the machine that changes meets both. Kernels are compiled before.

    The sweep is all of the command: its cluster's start and end, results on the disk, summary and pictures.
    """
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "study.toml"
        path.write_text(STUDY.format(trials=trials), encoding="utf-8")
        todo = Sweep(path, Path(folder) / "none").missing
        run_trial(todo[0])
        done = 0

        def step() -> None:
            nonlocal done
            done += 1
            progress(done, 2 * rounds * trials)

        def loop() -> None:
            for _ in in_processes(run_trial, todo, processes):
                step()

        def sweep() -> None:
            each = Sweep(path, Path(folder) / f"{len(rows)}")
            each.run(processes, None, lambda trial, result: step())
            each.finish()

        for _ in range(rounds):
            rows.append({f"loop_{name}": value for name, value in _spent(loop).items()})
            rows[-1] |= {f"sweep_{name}": value for name, value in _spent(sweep).items()}
    total = {name: sum(row[name] for row in rows) for name in rows[0]}
    return {
        "rounds": rows,
        "trials": trials,
        "processes": processes,
        "wall_ratio": total["sweep_wall_s"] / total["loop_wall_s"],
        "cpu_ratio": total["sweep_cpu_s"] / total["loop_cpu_s"],
        **machine(),
    }


def _spent(work: Callable[[], None]) -> dict[str, float]:
    """Seconds by the clock and of CPU, those of processes that have ended included."""
    began_s, before_s = time.monotonic(), _cpu_s()
    work()
    return {"wall_s": round(time.monotonic() - began_s, 2), "cpu_s": round(_cpu_s() - before_s, 2)}


def _cpu_s() -> float:
    both = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in both)
