"""One trial: a simulation with one seed, with all faults or none, and what it breaks. It may run on a worker."""

from __future__ import annotations

import gc
import hashlib
import importlib
import importlib.metadata
import platform
import random
import re
import time
import traceback
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import msgspec

from launch_scripts.simulation.faults import random_plan
from launch_scripts.simulation.laws import SLOW_MS, BrokenLaw, LawBook
from launch_scripts.simulation.sample_worlds import MIXED, world
from launch_scripts.simulation.simulate import Simulation, run_to_end
from shared_map.terrain.terrain import build_terrain
from swarm.config.scenario import Scenario
from swarm.errors import ConfigError, SwarmError
from swarm.runtime.process import collected_rarely

MIX = "mix"
"""Each seed in the world of `MIXED` that is its turn."""
SECONDS = 30.0
"""Faults in the first 18, quiet in the rest: a wait of ten seconds has its place in it."""
_STUTTER = 0.01
"""Share of calls within which processes are stopped, in every second seed."""
_SLOW_SEEDS = (6, 7)
"""Remainders by 8 of seeds with a slow link. One of the two also has processes stopped."""
_SLOWEST_MS = 1000.0
"""Greatest delay of a slow link. Chosen, not measured."""
_MORE_DELAYS = 12
"""Delays of its link by which a slow seed is quiet longer: an agent that was cut off and started again takes seven
round trips until its vehicles have routes."""

_PACKAGES = (
    "swarm",
    "shared_map",
    "planner_service",
    "vehicle_agent",
    "launch_scripts.simulation",
    "launch_scripts.observe",
)
_LIBRARIES = ("msgspec", "numba", "numpy", "scipy")
_VERSION_BYTES = 8
"""64 bits: a folder of results meets some hundred versions of the code, of which no two have the same digest by
chance, and the name stays short enough to read."""


@cache
def code_version() -> str:
    """Hexadecimal digits, the same on machines with the same sources and versions. Documentation in the sources
    counts, too: a repeated simulation costs less than a wrongly kept result."""
    digest = hashlib.blake2b(digest_size=_VERSION_BYTES)
    for name in _PACKAGES:
        folder = Path(importlib.import_module(name).__path__[0])
        for path in sorted((*folder.rglob("*.py"), *folder.rglob("*.toml"))):
            digest.update(f"{name}/{path.relative_to(folder).as_posix()}\0".encode())
            digest.update(hashlib.blake2b(path.read_bytes()).digest())
    versions = [platform.python_version(), *map(importlib.metadata.version, _LIBRARIES)]
    digest.update(" ".join(versions).encode())
    return digest.hexdigest()


LAWS = {"collisions": "no collision", "lethal_entries": "no lethal entry", "driven_into": "obstacles are avoided"}
"""Figure of a report that must be 0 -> the law. Outcomes of trials without faults."""
_LEFT_OUT = ("by_vehicle", "seed")


class Trial(msgspec.Struct, frozen=True):
    """Request to a worker.

    key       digest of all that decides the result, the version of the code included
    world     name of a small world, or that of the scenario
    scenario  None: the world says it
    version   of the code with which it is to run; None: whichever there is
    """

    key: str
    world: str
    scenario: Scenario | None
    seed: int
    seconds: float
    faults: bool
    version: str | None = None


class Result(msgspec.Struct, frozen=True, kw_only=True):
    """Reply of a worker.

    figures  every number of the run's report, by dotted key, but those of single vehicles
    broken   the laws that did not hold
    wall_s   by the clock, and cpu_s of the processor, both of the simulation and the building of its terrain
    """

    key: str
    figures: dict[str, float]
    broken: list[BrokenLaw]
    wall_s: float
    cpu_s: float


def run_trial(trial: Trial) -> Result:
    """Simulates. A service that raises is a broken law; raises SwarmError on what the study, its files or this
    worker have wrong."""
    if trial.version is not None and (own := code_version()) != trial.version:
        raise ConfigError(
            f"a worker has version {own} of the code, expected {trial.version}: install the same there"
        )
    began_s, cpu_s = time.perf_counter(), time.thread_time()
    report, broken = _with_faults(trial) if trial.faults else _plain(trial)
    gc.collect()  # services are cyclic, and collected rarely: a process would grow by 2 MB with each trial
    return Result(
        key=trial.key,
        figures=dict(numbers({name: value for name, value in report.items() if name not in _LEFT_OUT})),
        broken=broken,
        wall_s=time.perf_counter() - began_s,
        cpu_s=time.thread_time() - cpu_s,
    )


def numbers(value: Any, name: str = "") -> Iterator[tuple[str, float]]:
    """Dotted key and value of every number in a report."""
    match value:
        case bool():
            return
        case int() | float():
            yield name, float(value)
        case Mapping():
            for key, each in value.items():
                yield from numbers(each, f"{name}.{key}" if name else str(key))
        case list() | tuple():
            for n, each in enumerate(value):
                yield from numbers(each, f"{name}.{n}")


def _plain(trial: Trial) -> tuple[Mapping[str, Any], list[BrokenLaw]]:
    """Runs `swarm simulate SCENARIO --seed N`."""
    assert trial.scenario is not None
    simulation = Simulation(msgspec.structs.replace(trial.scenario, seed=trial.seed, seconds=trial.seconds))
    try:
        report = run_to_end(simulation)
    except SwarmError:
        raise
    except Exception as error:
        return {}, [_raised(error, simulation.now_s)]
    broken = {name: law for name, law in LAWS.items() if report.get(name)}
    return report, [BrokenLaw(law, f"{report[name]} {name.replace('_', ' ')}") for name, law in broken.items()]


def _with_faults(trial: Trial) -> tuple[Mapping[str, Any], list[BrokenLaw]]:
    """Runs `swarm simulate SCENARIO --seeds N:N+1`. The report also has `longest_wait_s`, see `laws.LawBook`;
    `routed_after_s`, from when all processes work again until every vehicle has a route, None if one never has; and
    `faults`, the number of each kind."""
    seed, seconds = trial.seed, trial.seconds
    if trial.scenario is None:
        scenario, terrain = world(trial.world, seed)
    else:
        scenario = msgspec.structs.replace(trial.scenario, seed=seed)
        terrain = build_terrain(scenario)
    plan = random_plan(scenario, seed, seconds)
    if not plan.hangs and seed % 2:  # a hang would end a stop early
        plan = msgspec.structs.replace(plan, stutter=_STUTTER)
    if seed % 8 in _SLOW_SEEDS:
        plan = msgspec.structs.replace(plan, delay_ms=random.Random(f"slow/{seed}").uniform(SLOW_MS, _SLOWEST_MS))
        seconds += _MORE_DELAYS * plan.delay_ms / 1000
    simulation = Simulation(scenario, faults=plan, terrain=terrain)
    book = LawBook(simulation)
    try:
        with collected_rarely():
            broken = book.run(seconds)
    except Exception as error:
        broken = [_raised(error, simulation.now_s)]
    report = simulation.report(seconds)
    waits = {"longest_wait_s": book.longest_s, "routed_after_s": book.routed_after_s}
    return report | waits | {"seconds": seconds, "faults": plan.counts()}, broken


def _raised(error: Exception, now_s: float) -> BrokenLaw:
    """Returns the violation that a service ended by an error."""
    where = traceback.extract_tb(error.__traceback__)[-1]
    text = f"{type(error).__name__}: {error} in {where.filename.rpartition('/')[2]}:{where.lineno}"
    return BrokenLaw("a service raised", f"a service raised at {now_s:.1f} s: {text}", now_s)


# --- seeds ------------------------------------------------------------------------------------------------------


def parse_seeds(text: str, where: str = "--seeds") -> range:
    """`A:B` is the seeds from A to B - 1. Raises ConfigError, which begins with `where`."""
    match = re.fullmatch(r"([0-9]{1,15}):([0-9]{1,15})", text)
    if match is None or int(match[1]) >= int(match[2]):
        raise ConfigError(f"{where}: {text!r} is not A:B with A < B, such as 0:100 for the seeds 0 to 99")
    return range(int(match[1]), int(match[2]))


def world_of(name: str, seed: int) -> str:
    return MIXED[seed % len(MIXED)] if name == MIX else name


def replay_of(name: str, seed: int, seconds: float, usual_s: float, option: str = "seeds") -> str:
    """The command that runs a seed again: with all faults, or by `option` "seed" without."""
    seeds = f"{seed}:{seed + 1}" if option == "seeds" else f"{seed}"
    longer = "" if seconds == usual_s else f" --seconds {seconds:g}"
    return f"swarm simulate {name} --{option} {seeds}{longer}"
