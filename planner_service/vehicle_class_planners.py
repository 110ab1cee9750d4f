"""Planners of one target for the classes of vehicles: one tree each, kept as long as it has queries."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator

from planner_service.planner import Planner
from swarm.clock import NS_PER_S
from swarm.config.explain import choice
from swarm.config.vehicle_classes import GROUND

UNUSED_NS = 60 * NS_PER_S
"""A tree without a query for this time is dropped."""
_BEGINS_NS = NS_PER_S
"""A query waits at most this time for the first tree of its class."""


class ClassPlanners:
    """The planner of "ground", which is always there, and those of other classes.

    make   makes the planner of a class
    known  the classes that there are, beside "ground"
    ready  whether the kernels which grow the trees of a class are loaded
    """

    def __init__(
        self,
        ground: Planner,
        make: Callable[[str], Planner],
        known: Collection[str],
        ready: Callable[[str], bool],
    ) -> None:
        self._make = make
        self._known = known
        self._ready = ready
        self._by_class: dict[str, Planner] = {GROUND: ground}
        self._used_ns: dict[str, int] = {}
        self._begun_ns: dict[str, int] = {}

    def __iter__(self) -> Iterator[tuple[str, Planner]]:
        """(class, planner) of all that there are, "ground" first."""
        return iter(list(self._by_class.items()))

    def fault(self, name: str) -> str | None:
        """Reason why nothing can be asked for a class; None if something can."""
        if name == GROUND:
            return None
        if name in self._known:
            return None if self._ready(name) else f"the kernels for class {name} are still being compiled"
        known = [GROUND, *self._known]
        return f"there is no class {name!r}{choice(name, known, ' there are ')}"

    def held(self, name: str) -> Planner | None:
        """The planner of a class, if it is there."""
        return self._by_class.get(name)

    def begun_ns(self, name: str) -> int:
        """Time when the planner of a class was made, which tells it from one that was dropped; 0 for "ground"."""
        return self._begun_ns.get(name, 0)

    def used(self, name: str, now_ns: int) -> Planner:
        """Returns the planner of a known class that is needed; made if it is missing."""
        planner = self._by_class.get(name)
        if planner is None:
            planner = self._by_class[name] = self._make(name)
            self._begun_ns[name] = now_ns
        self._used_ns[name] = now_ns
        return planner

    def must_wait(self, name: str, cells: list[int], now_ns: int) -> bool:
        """Returns True if a query from these cells should wait: no tree answers them yet, but soon."""
        planner = self._by_class[name]
        is_new = name in self._begun_ns and now_ns - self._begun_ns[name] < _BEGINS_NS
        return planner.must_wait(cells) or (is_new and planner.begins)

    def drop_unused(self, now_ns: int) -> None:
        """Drops trees that had no query for 60 s."""
        for name, used_ns in list(self._used_ns.items()):
            if name != GROUND and now_ns - used_ns >= UNUSED_NS:
                del self._by_class[name], self._used_ns[name], self._begun_ns[name]
