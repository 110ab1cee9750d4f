"""Compiling kernels: what a first route needs before the rest, by several processes, into numba's cache on disk.

    python -m planner_service.kernel_build [--directed | --all]

is one builder, for maps where uphill is not downhill or, without the option, for the others; or for both. Any
number of them, started by whomever, share the work: each claims a kernel by a lock on a file beside numba's,
compiles it and writes it there, where planners find it. A builder that dies leaves its claim.
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
from pathlib import Path
from typing import Any

from planner_service.kernels import (
    arrivals,
    bucket_queue,
    cell_costs,
    directed_buckets,
    lower_bounds,
    mend,
    parents,
    pieces_labels,
    pieces_mend,
    pieces_totals,
    repair,
    route_walk,
    stride_growth,
    stride_network,
    tied_parents,
    wide_buckets,
)
from planner_service.kernels.compile import StepKernel, cache_folder, is_loaded, is_on_disk, load

Kernel = Any
"""What `kernels.compile.kernel` makes; numba has no types."""

FIRST: tuple[Kernel | StepKernel, ...] = (
    route_walk.walk_routes,
    StepKernel(bucket_queue.grow_by_buckets, directed_buckets.grow_directed_by_buckets),
    parents.point_to_parents,
    StepKernel(wide_buckets.grow_by_wide_buckets, None),
    tied_parents.untie_parents,
    route_walk.join_routes,
    cell_costs.pad_cell_costs,
    route_walk.price_routes,
    cell_costs.changed_cells,
    route_walk.find_starts,
    route_walk.drive_rests,
    cell_costs.cell_cost_range,
    cell_costs.count_classes,
)
"""Enough to grow whole trees, to keep up with the map by growing them anew, and to give certified routes. What
takes longest comes first, so that builders end together."""

LATER: tuple[Kernel | StepKernel, ...] = (
    mend.mend,
    repair.repair,
    stride_growth.grow_strides,
    lower_bounds.bound_by_heuristic,
    cell_costs.cut_window,
    cell_costs.merge_window,
    cell_costs.find_rim,
    stride_network.cut_blocks,
    stride_network.find_ways_to_centres,
    stride_network.join_nodes,
    stride_growth.tighten,
    stride_network.write_paths,
    route_walk.relabel,
    pieces_mend.mend_tiles,
    pieces_labels.relabel_tiles,
    pieces_totals.evaluate,
    pieces_totals.find_risen,
    pieces_mend.cut_ways,
    pieces_mend.merge_parents,
    pieces_mend.drop_lost,
    pieces_totals.costs_at,
    arrivals.arrivals,
)
"""For windows, repairs, strides and pieces, which save growing whole trees."""

_POLL_S = 0.1
_BUILDERS = "builders.lock"
"""Each builder holds this lock shared, so that others see that one is at work."""


def first_kernels(directed: bool) -> list[Kernel]:
    """What a planner's first route takes. directed: its terrain is one where uphill is not downhill."""
    return _of_kind(FIRST, directed)


def later_kernels(directed: bool) -> list[Kernel]:
    """What a planner takes beside these."""
    return _of_kind(LATER, directed)


def all_kernels() -> list[Kernel]:
    """Of both kinds of map, each once: those that are asked for more often come first."""
    every = [kernel for directed in (False, True) for part in (FIRST, LATER) for kernel in _of_kind(part, directed)]
    return list({name_of(kernel): kernel for kernel in every}.values())


def _of_kind(kernels: Iterable[Kernel | StepKernel], directed: bool) -> list[Kernel]:
    found = [
        (each.directed if directed else each.alike) if isinstance(each, StepKernel) else each for each in kernels
    ]
    return [kernel for kernel in found if kernel is not None]


def name_of(kernel: Kernel) -> str:
    name: str = kernel.__name__
    return name


def missing(kernels: Iterable[Kernel]) -> list[Kernel]:
    """Those that this process cannot call yet without compiling."""
    return [kernel for kernel in kernels if not load(kernel, compiling=False)]


def can_build() -> bool:
    """Whether what a builder compiles can be found by others."""
    return cache_folder() is not None


def load_what_is_there() -> None:
    """Make ready what is on disk; or all, compiled here, where nothing can be kept."""
    if can_build():
        missing(all_kernels())
    else:
        load_all()


def load_all(directed: bool = False) -> None:
    """Make all kernels for one kind of map ready in this process, compiled here where they are not on disk."""
    for kernel in (*first_kernels(directed), *later_kernels(directed)):
        load(kernel)


def build(kernels: Iterable[Kernel], tell: Callable[[Kernel], None] = lambda _: None) -> None:
    """Compile what no other builder has compiled or is compiling; then wait for these. Tells each."""
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
                    tell(kernel)


@contextlib.contextmanager
def _locked(path: Path, how: int, remove: bool = True) -> Iterator[bool]:
    """Whether the lock was got. A file that is removed leaves two processes with a lock each, at worst."""
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
    """Whether a builder is at work."""
    folder = cache_folder()
    assert folder is not None
    with _locked(folder / _BUILDERS, fcntl.LOCK_EX | fcntl.LOCK_NB, remove=False) as alone:
        return not alone


class KernelLoader:
    """The kernels of one planner, which are compiled elsewhere.

    directed  its terrain is one where uphill is not downhill
    whole     the first route waits for all kernels: where growing a whole tree takes long, none should be grown
              only because another kernel is not there yet
    """

    def __init__(self, directed: bool, whole: bool) -> None:
        first = first_kernels(directed)
        self._directed = directed
        self._kernels = [*first, *later_kernels(directed)]
        self._first = self._kernels if whole else first
        self._missing = list(self._kernels)
        self._asked_s = -math.inf
        self.builders: list[subprocess.Popen[bytes]] = []
        """Those that were started because nobody was compiling."""
        self._thread = threading.Thread(target=self._load_rest, name="load-kernels", daemon=True)

    @property
    def complete(self) -> bool:
        """Whether all may be called. Once true, it stays so."""
        return not self._missing

    def load_first(self, tell: Callable[[str], None] = lambda _: None) -> None:
        """Wait until a first route can be planned; what comes after it is loaded as it is there. `tell` is handed a
        sentence now and then."""
        if not can_build():
            load_all(self._directed)
        began_s = told_s = time.monotonic()
        while waiting := missing(self._first):
            self._have_built()
            now_s = time.monotonic()
            if now_s - told_s > 2.0:
                told_s = now_s
                tell(f"compiling kernels: {len(waiting)} of {len(self._first)} left, {now_s - began_s:.0f} s")
            time.sleep(_POLL_S)
        self._missing = missing(self._kernels)
        if self._missing:
            self._thread.start()

    def wait(self) -> None:
        """Wait until all may be called."""
        if self._missing:
            self._thread.join()

    def _load_rest(self) -> None:
        while self._missing:
            self._have_built()
            time.sleep(5 * _POLL_S)
            self._missing = missing(self._missing)

    def _have_built(self) -> None:
        """See to it that somebody compiles what is missing."""
        now_s = time.monotonic()
        if now_s - self._asked_s > 20.0 and not is_building():
            self._asked_s = now_s
            command = [sys.executable, "-m", "planner_service.kernel_build", *["--directed"] * self._directed]
            self.builders = [subprocess.Popen(command) for _ in range(min(len(os.sched_getaffinity(0)), 8))]


def main() -> None:
    """Compile all kernels for one kind of map, or for both, those of a first route before the others."""
    os.nice(5)
    directed = "--directed" in sys.argv[1:]
    every = all_kernels() if "--all" in sys.argv[1:] else [*first_kernels(directed), *later_kernels(directed)]
    if can_build():
        build([each for each in every if not is_loaded(each)])


if __name__ == "__main__":
    main()
