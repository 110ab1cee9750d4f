"""Compiles kernels into numba's disk cache by several processes, those for a first route first.

    python -m planner_service.kernel_build [KERNEL ...]

is one builder, of these kernels in this order, or of all. Any number of them share the work:
each claims a kernel by a lock on a file beside numba's, compiles it and writes it there, where planners find it.
The lock of a builder that dies is released.
"""

from __future__ import annotations

import contextlib
import fcntl
import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

from planner_service.kernels import (
    any_angle_kernels,
    cell_costs,
    dial_growth,
    heap_and_buckets,
    lower_bounds,
    multilevel_growth,
    parents_from_costs,
    partial_growth_kernels,
    piece_totals,
    policy_iteration,
    repair,
    route_kernels,
    stride_networks,
    tile_pieces,
    tile_search,
)
from planner_service.kernels.decorators import BEFORE_LOAD, StepKernel, cache_folder, is_loaded, is_on_disk, load
from swarm.config.scenario import Scenario
from swarm.config.vehicle_classes import aloft_classes, first_classes
from swarm.runtime.loop_health import note

BEFORE_LOAD.append(note)
Kernel = Any
"""Result of `kernels.decorators.kernel`; numba has no types."""

FIRST: tuple[Kernel | StepKernel, ...] = (
    route_kernels.walk_routes,
    StepKernel(dial_growth.grow_by_buckets, None),
    multilevel_growth.grow_by_levels,
    parents_from_costs.point_to_parents,
    parents_from_costs.untie_parents,
    StepKernel(route_kernels.point_routes, None),
    StepKernel(partial_growth_kernels.find_aim, None),
    StepKernel(dial_growth.begin, None),
    partial_growth_kernels.open_cells,
    route_kernels.drive_rests,
    lower_bounds.bound_costs,
    cell_costs.changed_cells,
    cell_costs.block_ranges,
)
"""Kernels for full searches, for updates to the map by full searches, and for certified routes. The slowest to
compile comes first, so that builders end together."""

LATER: tuple[Kernel | StepKernel, ...] = (
    policy_iteration.mend,
    repair.repair,
    stride_networks.grow_strides,
    cell_costs.cut_window,
    cell_costs.merge_window,
    cell_costs.find_rim,
    stride_networks.cut_blocks,
    stride_networks.find_ways_to_centres,
    stride_networks.tighten,
    stride_networks.write_paths,
    tile_search.improve_tiles,
    tile_pieces.relabel_tiles,
    piece_totals.add_up,
    tile_search.cut_parents,
    tile_search.merge_parents,
    tile_search.drop_cut_off,
    piece_totals.costs_at,
    heap_and_buckets.arrivals,
)
"""For windows, repairs, strides and pieces, which save growing whole trees."""

GOALS = (partial_growth_kernels.stays_exact,)
"""Beside those of `FIRST`, for `GoalTrees`."""

PULL = any_angle_kernels.pull_routes
"""Only for planners that pull their routes."""

_POLL_S = 0.1
"""Interval of looks for kernels that another process compiles; five times as long once planning has begun. Chosen,
not measured."""
_BUILDERS = "builders.lock"
"""Each builder holds this lock shared, so that others see that one is at work."""


@dataclass(frozen=True, slots=True)
class NeededKernels:
    """Kernels that planners call, none of them twice. Builders and planners use the same list.

    first  needed until the first route of each class in `first_classes` is served
    later  for the other classes, and what saves growing whole trees
    """

    first: tuple[Kernel, ...]
    later: tuple[Kernel, ...]

    def __iter__(self) -> Iterator[Kernel]:
        """In the order in which they are needed."""
        yield from (*self.first, *self.later)


def needed_kernels(scenario: Scenario) -> NeededKernels:
    """Returns the kernels that the planners of a scenario call. Its ground may be isotropic while a flying class is
    directional."""
    ground, aloft = scenario.cost.directional, bool(aloft_classes(scenario))
    first, classes = _first_kernels(scenario)
    later = [*_of_kind(LATER, ground), *(_of_kind(LATER, True) if aloft else [])]
    return _needed(first, [*classes, *later])


def place_kernels(scenario: Scenario) -> NeededKernels:
    """Returns the kernels that the process which plans to places calls."""
    first, classes = _first_kernels(scenario)
    return _needed([*first, *GOALS], classes)


def _needed(first: Iterable[Kernel], later: Iterable[Kernel]) -> NeededKernels:
    once = dict.fromkeys(first)
    return NeededKernels(tuple(once), tuple(each for each in dict.fromkeys(later) if each not in once))


def _first_kernels(scenario: Scenario) -> tuple[list[Kernel], list[Kernel]]:
    """The kernels for the first routes of `first_classes`, and of the other classes."""
    ground, pulled = scenario.cost.directional, scenario.planner.routes == "pulled"
    # On a busy machine the later kernels may take longer than the run: no vehicle of it may wait for them.
    flown = not first_classes(scenario).isdisjoint(aloft_classes(scenario))
    first = _of_kind([*FIRST, PULL] if pulled and (flown or not ground) else FIRST, ground, ground or flown)
    return first, _of_kind([*FIRST, PULL] if pulled else FIRST, True) if aloft_classes(scenario) else []


def all_kernels() -> list[Kernel]:
    """Returns the kernels of planners on any map, each once: those needed more often come first."""
    parts = (_of_kind(part, kind) for part in (FIRST, LATER, GOALS, [PULL]) for kind in (False, True))
    return list(dict.fromkeys(chain(*parts)))


def _of_kind(kernels: Iterable[Kernel | StepKernel], *kinds: bool) -> list[Kernel]:
    """Returns the kernels for ground of these kinds; True: where uphill is not as downhill."""
    found = [
        (each.directed if directed else each.alike) if isinstance(each, StepKernel) else each
        for each in kernels
        for directed in kinds
    ]
    return [kernel for kernel in found if kernel is not None]


def name_of(kernel: Kernel) -> str:
    return str(kernel.__name__)


def missing(kernels: Iterable[Kernel]) -> list[Kernel]:
    """Returns the kernels that this process cannot call yet without compiling."""
    return [kernel for kernel in kernels if not load(kernel, compiling=False)]


def can_build() -> bool:
    """Returns True if the output of a builder can be found by others."""
    return cache_folder() is not None


def load_what_is_there() -> None:
    """Loads the kernels on disk; or compiles all here, if none can be kept."""
    if can_build():
        missing(all_kernels())
    else:
        load_all()


def load_all() -> None:
    """Makes all kernels for maps where uphill is as downhill ready in this process, compiled here where they are
    not on disk."""
    for kernel in _of_kind([*FIRST, *LATER], False):
        load(kernel)


def build(kernels: Iterable[Kernel], report: Callable[[Kernel], None] = lambda _: None) -> None:
    """Compiles what no other builder has compiled or is compiling; then waits for these. `report` is called for
    each."""
    folder = cache_folder()
    assert folder is not None
    waiting = list(kernels)
    with _locked(folder / _BUILDERS, fcntl.LOCK_SH, remove=False):
        for how in (fcntl.LOCK_EX | fcntl.LOCK_NB, fcntl.LOCK_EX):
            for kernel in list(waiting):
                with _locked(folder / f"{name_of(kernel)}.lock", how) as mine:
                    if mine and not is_on_disk(kernel):
                        load(kernel)
                if is_on_disk(kernel):
                    waiting.remove(kernel)
                    report(kernel)


@contextlib.contextmanager
def _locked(path: Path, how: int, remove: bool = True) -> Iterator[bool]:
    """Returns True if the lock was acquired. A file that is removed leaves two processes with a lock each, at
    worst. The folder may have been removed, too."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        try:
            fcntl.flock(file, how)
        except BlockingIOError:
            yield False
            return
        yield True
        if remove:
            path.unlink(missing_ok=True)


def is_building() -> bool:
    """Returns True if a builder is at work."""
    folder = cache_folder()
    assert folder is not None
    with _locked(folder / _BUILDERS, fcntl.LOCK_EX | fcntl.LOCK_NB, remove=False) as alone:
        return not alone


class KernelLoader:
    """The kernels of one planner, which are compiled elsewhere.

    needed  what it calls
    whole   the first route waits for all kernels: where growing a whole tree takes long, none should be grown
            only because another kernel is not there yet
    """

    def __init__(self, needed: NeededKernels, whole: bool) -> None:
        self._kernels = list(needed)
        self._first = self._kernels if whole else list(needed.first)
        self._missing = list(self._kernels)
        self._asked_s = -math.inf
        self.builders: list[subprocess.Popen[bytes]] = []
        """Builders that were started because no process was compiling."""
        self._thread = threading.Thread(target=self._load_rest, name="load-kernels", daemon=True)

    @property
    def complete(self) -> bool:
        """True if all may be called. Once true, it stays so."""
        return not self._missing

    def load_first(self, report: Callable[[str], None] = lambda _: None) -> None:
        """Waits until a first route can be planned; later kernels are loaded as they appear. `report` is handed a
        sentence now and then."""
        if not can_build():
            for kernel in self._kernels:
                load(kernel)
        began_s = reported_s = time.monotonic()
        while waiting := missing(self._first):
            self._have_built()
            now_s = time.monotonic()
            if now_s - reported_s > 10.0:
                reported_s = now_s
                report(f"compiling kernels: {len(waiting)} of {len(self._first)} left, {now_s - began_s:.0f} s")
            time.sleep(_POLL_S)
        self._missing = missing(self._kernels)
        if self._missing:
            self._thread.start()

    def _load_rest(self) -> None:
        while self._missing:
            self._have_built()
            time.sleep(5 * _POLL_S)
            self._missing = missing(self._missing)

    def _have_built(self) -> None:
        """Ensures that a process compiles the missing kernels."""
        now_s = time.monotonic()
        if now_s - self._asked_s > 20.0 and not is_building():
            self._asked_s = now_s
            command = [sys.executable, "-m", "planner_service.kernel_build", *map(name_of, self._missing)]
            self.builders = [subprocess.Popen(command) for _ in range(min(len(os.sched_getaffinity(0)), 8))]


def main() -> None:
    """Compiles the kernels that are named, or all of planners."""
    os.nice(5)
    every = {name_of(kernel): kernel for kernel in all_kernels()}
    names = sys.argv[1:] or list(every)
    if unknown := [name for name in names if name not in every]:
        sys.exit(f"expected names of kernels, found {unknown[0]!r}; there are {', '.join(every)}")
    if can_build():
        build([every[name] for name in names if not is_loaded(every[name])])


if __name__ == "__main__":
    main()
