"""What a run should be, by its scenario or by what its processes say. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

from swarm.config.agents import crew_of
from swarm.config.scenario import Scenario
from swarm.liveness import split_rank
from swarm.runtime.order_book import OrderBook
from swarm.wire.messages.processes import RunInfo


@dataclass(frozen=True, slots=True)
class RunPlan:
    """What a complete run has.

    crew        (role, id) of the processes that it needs: no router, which belongs to no run, and no monitor
    vehicles    of the scenario; guests come on top
    started_ns  when the run began; None: with the first that is heard of it
    """

    targets: tuple[str, ...]
    crew: tuple[tuple[str, str], ...]
    vehicles: int
    started_ns: int | None = None

    def targets_now(self, book: OrderBook) -> list[str]:
        """The targets after what operators have ordered."""
        targets = dict.fromkeys(self.targets)
        for order in book:
            if order.subject == "target":
                if order.off:
                    targets.pop(order.name, None)
                elif order.added:
                    targets[order.name] = None
        return list(targets)

    def crew_now(self, targets: Iterable[str]) -> list[tuple[str, str]]:
        """The processes that the run needs while it has these targets."""
        wanted = list(targets)
        kept = [each for each in self.crew if each[0] != "planner" or split_rank(each[1])[0] in wanted]
        planned = {split_rank(id)[0] for role, id in kept if role == "planner"}
        return [*kept, *(("planner", id) for id in wanted if id not in planned)]


def plan_of(scenario: Scenario, started_ns: int | None = None) -> RunPlan:
    """By the scenario."""
    return RunPlan(tuple(scenario.target_ids), tuple(crew_of(scenario)), scenario.vehicle_count, started_ns)


def run_of_most(found: Iterable[RunInfo]) -> tuple[str, str]:
    """(run id, terrain) that most answers name; empty texts where only routers answer, which belong to no run."""
    runs = Counter((info.run_id, info.terrain) for info in found if info.run_id)
    return runs.most_common(1)[0][0] if runs else ("", "")


def plan_of_members(members: Iterable[RunInfo]) -> RunPlan:
    """By what the processes of a run answer: the same as by its scenario."""
    told = [info for info in members if info.run_id]
    crew = dict.fromkeys(
        (role, id) for info in told for role, _, id in (name.partition("-") for name in info.crew) if id
    )
    targets = tuple(id for role, id in crew if role == "planner" and not split_rank(id)[1])
    began = [info.started_ns for info in told if info.started_ns > 0]
    vehicles = max((info.vehicles for info in told), default=0)
    return RunPlan(targets, tuple(crew), vehicles, min(began, default=None))
