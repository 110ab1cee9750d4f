"""One seed of a world with everything at once, and what it breaks; many seeds, over the processors of a machine."""

from __future__ import annotations

import functools
import multiprocessing
import random
import re
import signal
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import replace
from itertools import islice
from typing import Any, TypeVar

import msgspec

from launch_scripts.parent_death import end_with_parent
from launch_scripts.simulation.faults import random_plan
from launch_scripts.simulation.laws import SLOW_MS, BrokenLaw, LawBook
from launch_scripts.simulation.simulate import Simulation
from launch_scripts.simulation.worlds import MIXED, world
from shared_map.terrain.terrain import build_terrain
from swarm.config.scenario import Scenario
from swarm.errors import ConfigError
from swarm.runtime.process import collected_rarely

T = TypeVar("T")
R = TypeVar("R")

MIX = "mix"
"""Each seed in the world of `MIXED` that is its turn."""
SECONDS = 30.0
"""Faults in the first 18, quiet in the rest: a wait of ten seconds has its place in it."""
_STUTTER = 0.01
"""Share of calls within which processes are stopped, in every second seed."""
_SLOW_SEEDS = (6, 7)
"""Remainders by 8 of seeds with a slow link. One of the two also has processes stopped."""
_SLOWEST_MS = 1000.0


class Verdict(msgspec.Struct, frozen=True, kw_only=True):
    """Result of one seed.

    broken          each law that did not hold
    longest_wait_s  see `laws.LawBook`
    routed_after_s  from when all processes work again until every vehicle has a route; None if one never has
    faults          how many of each kind there were
    """

    world: str
    seed: int
    seconds: float
    broken: list[BrokenLaw]
    longest_wait_s: float = 0.0
    routed_after_s: float | None = None
    captures: int = 0
    deliveries: int = 0
    faults: dict[str, int] = {}
    wall_s: float = 0.0

    @property
    def replay(self) -> str:
        """The command that runs this seed again."""
        return replay_of(self.world, self.seed, self.seconds, SECONDS)


def replay_of(name: str, seed: int, seconds: float, usual_s: float, option: str = "seeds") -> str:
    """The command that runs a seed again: with all faults, or by `option` "seed" without."""
    seeds = f"{seed}:{seed + 1}" if option == "seeds" else f"{seed}"
    longer = "" if seconds == usual_s else f" --seconds {seconds:g}"
    return f"swarm simulate {name} --{option} {seeds}{longer}"


def try_seed(
    name: str, seed: int, seconds: float = SECONDS, given: Scenario | None = None
) -> tuple[Verdict, dict[str, Any]]:
    """Runs a world with all faults of a seed. A service that raises is a broken law, too.

    given  the scenario of that name, where it is none of `WORLDS`

    Returns the verdict, and the figures of the run's report.
    """
    if given is None:
        scenario, terrain = world(name, seed)
    else:
        scenario = msgspec.structs.replace(given, seed=seed)
        terrain = build_terrain(scenario)
    plan = random_plan(scenario, seed, seconds)
    if not plan.hangs and seed % 2:  # a hang would end a stop early
        plan = replace(plan, stutter=_STUTTER)
    if seed % 8 in _SLOW_SEEDS:
        plan = replace(plan, delay_ms=random.Random(f"slow/{seed}").uniform(SLOW_MS, _SLOWEST_MS))
    simulation = Simulation(scenario, faults=plan, terrain=terrain)
    began_s = time.perf_counter()
    book = LawBook(simulation)
    try:
        with collected_rarely():
            broken = book.run(seconds)
    except Exception as error:
        broken = [raised(error, simulation.now_s)]
    report = simulation.report(seconds)
    verdict = Verdict(
        world=name,
        seed=seed,
        seconds=seconds,
        broken=broken,
        longest_wait_s=book.longest_s,
        routed_after_s=book.routed_after_s,
        captures=report["captures"] or 0,
        deliveries=simulation.log.deliveries,
        faults=plan.counts(),
        wall_s=time.perf_counter() - began_s,
    )
    return verdict, report


def raised(error: Exception, now_s: float) -> BrokenLaw:
    """Returns the violation that a service ended by an error."""
    where = traceback.extract_tb(error.__traceback__)[-1]
    text = f"{type(error).__name__}: {error} in {where.filename.rpartition('/')[2]}:{where.lineno}"
    return BrokenLaw("a service raised", f"a service raised at {now_s:.1f} s: {text}", now_s)


# --- many seeds -----------------------------------------------------------------------------------------------


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
    """Try each seed; yields verdicts as they come. The result depends only on world, seed and `seconds`, not on
    `jobs` or on other seeds.

    name   a world, `MIX`, or the name of the scenario that is `given`
    """
    yield from in_processes(functools.partial(_try, name, seconds, given), seeds, jobs)


def _try(name: str, seconds: float, given: Scenario | None, seed: int) -> Verdict:
    return try_seed(world_of(name, seed), seed, seconds, given)[0]


def in_processes(work: Callable[[T], R], items: Sequence[T], jobs: int) -> Iterator[R]:
    """Calls `work` with each item, in a number of processes at a time; yields results as they come. The processes
    end with this one, and when the caller stops to read. An exception of `work` ends all."""
    if jobs == 1 or len(items) == 1:
        yield from map(work, items)
        return
    # Children of their own, not forks: numpy and numba have threads.
    executor = ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn"), _begin)
    before = set(multiprocessing.active_children())
    waiting: set[Future[R]] = set()
    rest = iter(items)
    try:
        while waiting := waiting | {executor.submit(work, item) for item in islice(rest, jobs + 1 - len(waiting))}:
            done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
            yield from (future.result() for future in done)
    finally:
        if waiting:
            for child in set(multiprocessing.active_children()) - before:
                child.terminate()
        executor.shutdown(cancel_futures=True)


def _begin() -> None:
    """In a child: a Ctrl-C, which reaches the whole process group, is for the parent alone to act upon."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent(signal.SIGKILL)
