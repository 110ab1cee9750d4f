"""What a planner wants done by the process around it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from planner_service.full_growth import GrownTree
from planner_service.tree.strides import StrideSearch
from swarm.wire.messages.planning import Believed, PlannerStatus, PushedRoute


@dataclass(frozen=True, slots=True)
class Refusal:
    """A request that is not answered, and why."""

    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class GrowTree:
    """Run `job` on a worker and bring what it returns to `Planner.adopt`."""

    job: Callable[[], GrownTree]


@dataclass(frozen=True, slots=True, eq=False)
class FindStrides:
    """Take the steps of `search` on a worker, one now and then, until it has found them; bring it to
    `Planner.adopt_strides`."""

    search: StrideSearch


@dataclass(frozen=True, slots=True)
class Tell:
    """A sentence for people who watch the run; `cell` is where, if anywhere."""

    kind: str
    text: str
    cell: int | None = None


Action = GrowTree | FindStrides | PushedRoute | PlannerStatus | Believed | Tell
"""What a planner wants done: a growth run, networks of strides found, a message published."""
