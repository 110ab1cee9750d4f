"""Checks whether this machine and its installation can run a swarm, and whether it is large enough for a
scenario."""

from __future__ import annotations

import ctypes
import importlib.metadata
import os
import platform
import resource
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from launch_scripts.check import Finding, Level, failure, warning
from launch_scripts.deploy.machines_needed import needs_on, swarm_of
from launch_scripts.observe.run_folders import OURS, version_of
from launch_scripts.process_table import processes_of
from swarm.config import scenario as settings
from swarm.config.input_files import size
from swarm.config.scenario import NetworkConfig, Scenario
from swarm.errors import StoreError, SwarmError
from swarm.files import check_writable

_ENOUGH_BYTES = 1 << 30
"""Minimum of free memory, and of free disk."""
_ENOUGH_FILES = 1024
"""Open files that a process may need; fewer are warned of. Chosen, not measured."""
_EXTRAS = ("", "planner", "terrain", "roles", "vectors", "view")
"""The base and the extras of a swarm: each brings the packages of some before it. This command itself needs the
first three."""
_UNSYNCHRONISED = 5
"""Result of `adjtimex` for a clock that is not synchronised: TIME_ERROR."""
_TIMEX_BYTES = 256
"""Above the size of Linux's `struct timex`, 208 bytes on 64-bit machines: the kernel writes all of it."""

_PROCESS_BYTES = 31 << 20
_VEHICLE_BYTES = 230 << 10
"""With the bytes of a process: 650 and 920 MB where 100 and 1,000 vehicles took 610 and 920 (`bench swarm`)."""
_TREE_CELL_BYTES = 24
_BUSY_SHARE = 3 / 4
"""Beyond this share of the cores ticks are late: none of them at 1.4 cores of 2, 10 % at 1.9."""
_FEW_AGENTS = 5
"""Agents up to which no larger `per_agent` is advised. Chosen, not measured."""
_CELL_BYTES = 30
"""Bytes of the terrain, which all processes share, and of its file in the folder of a run."""
_RECORDING_BYTES_PER_MINUTE = 20 << 20
"""A rule of thumb on the safe side: a thousand vehicles were recorded with 9 MB a minute, and with 24 before routes
were drawn as trees."""
_MOST_BYTES = 1 << 60
"""An exbibyte, above what any time that a scenario may name (`MOST_SECONDS`) comes to: the number stays within 64
bits."""


class Resources(NamedTuple):
    """Resources of this machine: processor cores, and free bytes of memory and of the disk of a folder of runs."""

    cores: int
    free_bytes: int
    disk_bytes: int


class RunNeeds(NamedTuple):
    """Estimated needs of a scenario.

    cores            that are busy all the time
    planner_cores    of these, cores of one planner
    disk_bytes       in the folder of the run
    recording_bytes  of these, bytes written while the run lasts
    """

    processes: int
    agents: int
    cores: float
    planner_cores: float
    memory_bytes: int
    disk_bytes: int
    recording_bytes: int


def this_machine(runs: Path) -> Resources:
    """Returns the resources of this machine, with the disk of a folder of runs."""
    import psutil

    free_bytes, disk_bytes = psutil.virtual_memory().available, shutil.disk_usage(_nearest(runs)).free
    return Resources(len(os.sched_getaffinity(0)), free_bytes, disk_bytes)


def needs_of(scenario: Scenario, cells: int) -> RunNeeds:
    """Returns the needs of a scenario on a terrain of `cells` cells."""
    vehicles, standbys = scenario.vehicle_count, scenario.standbys.planner
    agents, processes = len(settings.plan_agents(scenario)), len(processes_of(scenario))
    trees = len(scenario.target_ids) * (1 + standbys)
    memory = (
        processes * _PROCESS_BYTES + vehicles * _VEHICLE_BYTES + cells * (_CELL_BYTES + trees * _TREE_CELL_BYTES)
    )
    classes = 1 + len(scenario.classes)
    kept = settings.place_trees_bytes(settings.PLACE_TREES_BYTES, classes, cells)
    memory += len(settings.places_of(scenario)) * classes * (kept + cells * _TREE_CELL_BYTES)
    lasts_s = scenario.seconds if scenario.seconds < settings.UNTIL_STOPPED_S else 0.0  # how long is not known
    recording = int(min(lasts_s / 60 * _RECORDING_BYTES_PER_MINUTE, _MOST_BYTES))
    taken = needs_on(1, swarm_of(scenario, cells), standbys)
    cores, planner_cores = sum(taken.cpu_cores.values()), taken.process["planner"]
    disk = cells * _CELL_BYTES + recording
    return RunNeeds(processes, agents, cores, planner_cores, memory, disk, recording)


def against(scenario: Scenario, needs: RunNeeds, here: Resources, runs: Path) -> Iterator[Finding]:
    """Yields findings for each resource of which the machine has less than a run needs."""
    if needs.cores > _BUSY_SHARE * here.cores:
        hz = scenario.vehicles.tick_hz
        fewer = " a larger vehicles.per_agent," if needs.agents > max(_FEW_AGENTS, 2 * here.cores) else ""
        yield warning(
            "vehicles",
            f"{scenario.vehicle_count:,} vehicles of {needs.agents} agents and {len(scenario.target_ids):,} targets"
            f" at {hz:g} Hz keep about {needs.cores:.1f} cores busy, and there are {here.cores}: ticks will be"
            f" late;{fewer} fewer of them, a lower vehicles.tick_hz, or more machines"
            " (docs/method/measurements.md)",
        )
    if needs.memory_bytes > here.free_bytes:
        yield warning(
            "memory",
            f"about {size(needs.memory_bytes)} are needed and {size(here.free_bytes)} are free: a larger"
            " terrain.resolution_m, or fewer targets",
        )
    if needs.disk_bytes > here.disk_bytes:
        # One that is meant to be ended by Ctrl-C names a time that never comes.
        starts = needs.disk_bytes - needs.recording_bytes <= here.disk_bytes
        yield (warning if starts else failure)(
            "disk",
            f"about {size(needs.disk_bytes)} are written to {runs} and {size(here.disk_bytes)} are free: another"
            " --runs, or a shorter run",
        )
    if (complaint := _unwritable(runs)) is not None:
        yield failure("runs", complaint)


def why_no_room(scenario: Scenario, cells: int, planners: int, here: Resources) -> str | None:
    """Reason why this machine cannot carry planners beside a scenario; None if it can.

    A quarter of its cores is for such planners, even where the scenario needs the others.
    """
    needs = needs_of(scenario, cells)
    share = max(_BUSY_SHARE * here.cores - needs.cores, (1 - _BUSY_SHARE) * here.cores)
    if planners > (most := int(share / needs.planner_cores)):
        return f"{planners} planners of added targets, and this machine of {here.cores} cores carries {most}"
    if (wanted := _PROCESS_BYTES + cells * _TREE_CELL_BYTES) > here.free_bytes:
        return f"it needs about {size(wanted)} of memory, and {size(here.free_bytes)} are free"
    return None


def _nearest(runs: Path) -> Path:
    """Returns a folder of runs, or the nearest existing folder above it."""
    return next(path for path in (runs.absolute(), *runs.absolute().parents) if path.exists())


def _unwritable(runs: Path) -> str | None:
    """Reason why no run can be left in a folder of runs; None if one can."""
    try:
        check_writable(_nearest(runs))
    except StoreError as error:
        return f"{error}; choose another --runs"
    return None


# --- swarm doctor: each check says how it is, and what to do if that is not well

Result = tuple[Level, str]


def examine(runs: Path) -> Iterator[Finding]:
    """Everything, one after the other. A thing that cannot be looked at is a warning, never an error."""
    for about, check in CHECKS.items():
        try:
            level, text = check(runs)
            yield Finding(level, about, text)
        except (SwarmError, OSError, ValueError, ImportError, AttributeError) as error:
            yield warning(about, f"cannot be looked at: {error}")


def _packages(runs: Path) -> Result:
    from packaging.requirements import Requirement

    every = list(map(Requirement, importlib.metadata.requires(OURS) or ()))
    here = {each.name: version_of(each.name) for each in every}
    extra_of = {
        each.name: (extra, each)
        for extra in reversed(_EXTRAS)  # so that the smallest that brings a package remains
        for each in every
        if each.marker is None or each.marker.evaluate({"extra": extra})
    }
    brings = Counter(extra for extra, _ in extra_of.values())
    there = Counter(extra for name, (extra, _) in extra_of.items() if here[name])
    # No installer records extras. Another program may have brought a few of the packages.
    absent = [extra for extra in _EXTRAS[3:] if 2 * there[extra] < brings[extra]]
    wrong = [
        f"{name} is {here[name] or 'missing'}, expected {each.specifier} ({extra or 'always'})"
        for name, (extra, each) in extra_of.items()
        if extra not in absent and not each.specifier.contains(here[name] or "0", prereleases=True)
    ]
    if wrong:
        return "failure", f"{'; '.join(wrong)}: install the extras in brackets (docs/start/install.md)"
    without = f"; not installed: the extras {', '.join(absent)} (docs/start/install.md)" if absent else ""
    python, zenoh = platform.python_version(), here["eclipse-zenoh"]
    return "ok", f"all fit; {OURS} {version_of(OURS)}, zenoh {zenoh}, Python {python}{without}"


def _planner_kernels(runs: Path) -> Result:
    from planner_service.kernel_build import all_kernels
    from planner_service.kernels.decorators import cache_folder, code_folder, is_on_disk

    folder, kernels = code_folder(), list(all_kernels())
    if folder is None:
        kept = "compiled planners can be kept nowhere, so every start compiles"
        return "failure", f"{kept}: set NUMBA_CACHE_DIR to a folder"
    cold = sum(not is_on_disk(kernel) for kernel in kernels)
    if cold and cache_folder() is None:
        there = (
            f"{cold} of {len(kernels)} are not in {folder}, which can only be read, so every start compiles them"
        )
        return "failure", f"{there}: `python -m planner_service.kernel_build` makes them where it can be written to"
    if cold:
        return "warning", f"{cold} of {len(kernels)} are not compiled yet: the first start takes half a minute"
    return "ok", f"all {len(kernels)} are compiled, in {folder}"


def _cores(runs: Path) -> Result:
    cores, load = len(os.sched_getaffinity(0)), os.getloadavg()[0]
    if cores < 2:
        return "warning", "1: processes take turns, so ticks will be late; two are enough for the demo"
    if load > cores:
        return "warning", f"{cores}, with a load of {load:.1f} from other work: ticks will be late"
    return "ok", f"{cores}, load {load:.1f}"


def _memory(runs: Path) -> Result:
    free = this_machine(runs).free_bytes
    if free < _ENOUGH_BYTES:
        return "warning", f"{size(free)} are free; the demo takes about 0.6 GB: end something else first"
    return "ok", f"{size(free)} are free"


def _open_files(runs: Path) -> Result:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != resource.RLIM_INFINITY and soft < _ENOUGH_FILES:
        return "warning", f"{soft} at a time, too few for a router of many: `ulimit -n {min(4096, hard)}`"
    return "ok", "any number at a time" if soft == resource.RLIM_INFINITY else f"{soft} at a time"


def _zenoh(runs: Path) -> Result:
    from launch_scripts.ports import free_ports
    from swarm.bus.zenoh_bus import open_bus

    (port,) = free_ports(1)
    endpoint = f"tcp/127.0.0.1:{port}"
    network = NetworkConfig(listen=(endpoint,), connect=(endpoint,), connect_timeout_s=5.0)
    began_s = time.monotonic()
    try:
        with open_bus(network, mode="router"), open_bus(network):
            took_ms = (time.monotonic() - began_s) * 1e3
    except SwarmError as error:
        return "failure", f"no session over loopback: {error}; is there a firewall on 127.0.0.1?"
    return "ok", f"two sessions met on 127.0.0.1:{port} within {took_ms:.0f} ms"


def _clock(runs: Path) -> Result:
    # All zero asks and changes nothing. A state below 0: the kernel gives none.
    state = int(ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(_TIMEX_BYTES)))
    if state == _UNSYNCHRONISED:
        return "warning", "not synchronised (no NTP), which several machines need: start chrony or ntpd"
    return "ok", "synchronised" if state >= 0 else "whether it is synchronised is not known"


def _disk(runs: Path) -> Result:
    if (complaint := _unwritable(runs)) is not None:
        return "failure", complaint
    folder = _nearest(runs)
    free = shutil.disk_usage(folder).free
    if free < _ENOUGH_BYTES:
        return "warning", f"{size(free)} are free in {folder}; a minute of a large swarm writes some 20 MB"
    return "ok", f"{size(free)} are free in {folder}"


CHECKS: dict[str, Callable[[Path], Result]] = {
    check.__name__.strip("_").replace("_", " "): check
    for check in (
        _packages, _planner_kernels, _cores, _memory, _open_files, _zenoh, _clock, _disk,
    )
}  # fmt: skip
"""The checks by their names, in order."""
