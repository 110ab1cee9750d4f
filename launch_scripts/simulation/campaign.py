"""Many seeds, over several processes of this machine: a stream of verdicts."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from itertools import islice

from launch_scripts.simulation.trial import SECONDS, Verdict, try_seed
from launch_scripts.simulation.worlds import WORLDS
from swarm.config.scenario import Scenario

MIX = "mix"
"""Each seed in the world of `WORLDS` that is its turn."""


def world_of(name: str, seed: int) -> str:
    return WORLDS[seed % len(WORLDS)] if name == MIX else name


def run_seeds(
    name: str, seeds: Sequence[int], jobs: int, seconds: float = SECONDS, given: Scenario | None = None
) -> Iterator[Verdict]:
    """Try each seed; yields verdicts as they come. What a seed does depends on nothing but its world and number.

    name   a world, `MIX`, or the name of the scenario that is `given`
    """
    if jobs == 1 or len(seeds) == 1:
        for seed in seeds:
            yield try_seed(world_of(name, seed), seed, seconds, given)
        return
    # Children of their own, not forks: numpy and numba have threads.
    context = multiprocessing.get_context("spawn")
    executor = ProcessPoolExecutor(jobs, mp_context=context)
    waiting: set[Future[Verdict]] = set()
    rest = iter(seeds)
    try:
        while True:
            for seed in islice(rest, jobs + 1 - len(waiting)):
                waiting.add(executor.submit(try_seed, world_of(name, seed), seed, seconds, given))
            if not waiting:
                return
            done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
            for future in done:
                yield future.result()
    finally:
        executor.shutdown(wait=False, cancel_futures=True)
