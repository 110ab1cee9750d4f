"""One trial: a simulation with one seed, and what became of it. Runs on a worker."""

from __future__ import annotations

import hashlib
import importlib
import importlib.metadata
import platform
import time
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import msgspec

from launch_scripts.simulation.laws import BrokenLaw
from launch_scripts.simulation.many_seeds import raised, try_seed
from launch_scripts.simulation.simulate import Simulation
from swarm.config.scenario import Scenario
from swarm.errors import ConfigError, SwarmError
from swarm.runtime.process import collected_rarely

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


LAWS = {
    "collisions": "no collision",
    "lethal_entries": "no lethal entry",
    "driven_into": "obstacles are avoided",
}
"""Figure of a report that must be 0 -> the law. Outcomes of trials without faults."""
_LEFT_OUT = ("by_vehicle", "seed")


class Trial(msgspec.Struct, frozen=True):
    """Request to a worker.

    key       digest of all that decides the result, the version of the code included
    world     name of a small world, or that of the scenario
    scenario  None: the world says it
    version   of the code with which it is to run
    """

    key: str
    world: str
    scenario: Scenario | None
    seed: int
    seconds: float
    faults: bool
    version: str


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

    @property
    def first(self) -> BrokenLaw | None:
        """The first law that broke."""
        return self.broken[0] if self.broken else None


def run_trial(trial: Trial) -> Result:
    """Simulate. A service that raises is a broken law; raises SwarmError on what the study, its files or this
    worker have wrong."""
    if (own := code_version()) != trial.version:
        raise ConfigError(
            f"a worker has version {own} of the code, expected {trial.version}: install the same there"
        )
    began_s, cpu_s = time.perf_counter(), time.thread_time()
    report, broken = _with_faults(trial) if trial.faults else _plain(trial)
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
        with collected_rarely():
            simulation.run_until(trial.seconds)
            simulation.finish()
    except SwarmError:
        raise
    except Exception as error:
        return {}, [raised(error, simulation.now_s)]
    report = simulation.report(trial.seconds)
    broken = {name: law for name, law in LAWS.items() if report.get(name)}
    return report, [BrokenLaw(law, f"{report[name]} {name.replace('_', ' ')}") for name, law in broken.items()]


def _with_faults(trial: Trial) -> tuple[Mapping[str, Any], list[BrokenLaw]]:
    """Runs `swarm simulate SCENARIO --seeds N:N+1`."""
    verdict, report = try_seed(trial.world, trial.seed, trial.seconds, trial.scenario)
    told: dict[str, Any] = msgspec.to_builtins(verdict)
    del told["broken"], told["wall_s"]
    return report | told, verdict.broken
