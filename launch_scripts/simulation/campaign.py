"""Many seeds, over several processes of this machine: a stream of verdicts."""

from __future__ import annotations

import functools
import multiprocessing
import re
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from itertools import islice
from typing import TypeVar

from launch_scripts.parent_death import end_with_parent
from launch_scripts.simulation.trial import SECONDS, Verdict, try_seed
from launch_scripts.simulation.worlds import MIXED
from swarm.config.scenario import Scenario
from swarm.errors import ConfigError

T = TypeVar("T")
R = TypeVar("R")

MIX = "mix"
"""Each seed in the world of `MIXED` that is its turn."""


def parse_seeds(text: str, where: str = "--seeds") -> range:
    """`A:B` is the seeds from A to B - 1. Raises ConfigError, which begins with `where`."""
    match = re.fullmatch(r"([0-9]{1,15}):([0-9]{1,15})", text)
    if match is None or int(match[1]) >= int(match[2]):
        raise ConfigError(f"{where}: {text!r} is not A:B with A < B, such as 0:100 for the seeds 0 to 99")
    return range(int(match[1]), int(match[2]))


def world_of(name: str, seed: int) -> str:
    return MIXED[seed % len(MIXED)] if name == MIX else name


def run_seeds(
    name: str, seeds: Sequence[int], jobs: int, seconds: float = SECONDS, given: Scenario | None = None
) -> Iterator[Verdict]:
    """Try each seed; yields verdicts as they come. What a seed does depends on nothing but its world and number.

    name   a world, `MIX`, or the name of the scenario that is `given`
    """
    yield from in_processes(functools.partial(_try, name, seconds, given), seeds, jobs)


def _try(name: str, seconds: float, given: Scenario | None, seed: int) -> Verdict:
    return try_seed(world_of(name, seed), seed, seconds, given)


def in_processes(work: Callable[[T], R], items: Sequence[T], jobs: int) -> Iterator[R]:
    """Call `work` with each item, in so many processes at a time; yields results as they come. The processes end
    with this one, and when the caller stops to read. What `work` raises ends all."""
    if jobs == 1 or len(items) == 1:
        yield from map(work, items)
        return
    # Children of their own, not forks: numpy and numba have threads.
    executor = ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn"), _begin)
    before = set(multiprocessing.active_children())
    waiting: set[Future[R]] = set()
    rest = iter(items)
    try:
        while True:
            for item in islice(rest, jobs + 1 - len(waiting)):
                waiting.add(executor.submit(work, item))
            if not waiting:
                return
            done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
            for future in done:
                yield future.result()
    finally:
        if waiting:
            for child in set(multiprocessing.active_children()) - before:
                child.terminate()
        executor.shutdown(cancel_futures=True)


def _begin() -> None:
    """In a child: a Ctrl-C, which reaches the whole process group, is for the parent alone to act upon."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent(signal.SIGKILL)
