"""Digests of the event logs of simulated runs, which are equal before and after a change that changes nothing.

    PYTHONPATH=.:tests python -m support.event_digests > after.txt

A line for each run: world or scenario, seed, deliveries, digest of the log. Worlds run with faults, scenarios not.
"""

import hashlib
import sys
from typing import Any

import msgspec

from launch_scripts.launcher.run_options import find_scenario
from launch_scripts.simulation.faults import random_plan
from launch_scripts.simulation.sample_worlds import WORLDS, world
from launch_scripts.simulation.simulate import Simulation

SECONDS = 12.0
RUNS = (
    *((name, seed) for name in WORLDS for seed in (1, 2)),
    *((name, 3) for name in ("jacksboro", "walkers", "aloft", "obstacles", "clustered", "demo", "synthetic")),
)


class _Digest:
    """A text file of which only the digest is kept."""

    def __init__(self) -> None:
        self.sum = hashlib.sha256()

    def write(self, text: str) -> int:
        self.sum.update(text.encode())
        return len(text)

    def flush(self) -> None:
        pass


def digest_of(name: str, seed: int, seconds: float = SECONDS) -> tuple[int, str]:
    """Number of deliveries and hexadecimal digest of the event log of one run."""
    log: Any = _Digest()
    if name in WORLDS:
        scenario, terrain = world(name, seed)
        plan = random_plan(scenario, seed, seconds)
        simulation = Simulation(scenario, faults=plan, terrain=terrain, trace=log)
    else:
        scenario = msgspec.structs.replace(find_scenario(name), seed=seed, seconds=seconds)
        simulation = Simulation(scenario, trace=log)
    simulation.run_until(seconds)
    simulation.finish()
    return simulation.deliveries, log.sum.hexdigest()[:16]


def main() -> None:
    chosen = [run for run in RUNS if not sys.argv[1:] or run[0] in sys.argv[1:]]
    for name, seed in chosen:
        deliveries, digest = digest_of(name, seed)
        sys.stdout.write(f"{name} {seed} {deliveries} {digest}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
