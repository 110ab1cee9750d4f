"""The planners of targets that operators add while the swarm runs, and the end of those whose target is removed."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, field

import msgspec

from launch_scripts.launcher.local_processes import LocalSwarm
from launch_scripts.process_table import ProcessSpec
from swarm.config.scenario import Scenario
from swarm.errors import SwarmError
from swarm.peers import job_of, ranked_id
from swarm.runtime.order_book import OrderBook

LEAVES_TO_OTHERS_S = 3.0
"""A launcher of a part of a swarm starts such a planner only if none has appeared for this time."""

_BEGIN_AT_ONCE = 2
"""Planners for added targets that start at one time. Chosen, not measured."""
_BEGINS_WITHIN_S = 10.0
"""A planner that has not come up by then holds up no other."""


@dataclass(slots=True)
class OrderedPlanners:
    """Starts and ends planners on this machine according to orders.

    ranks      which of an added target's planners to start here
    own        processes that this launcher started: for the scenario's targets, it manages only these planners
    is_whole   whether this launcher started the whole swarm: then no other will start them
    say        tells the user
    no_room    number of planners of added targets here -> reason why the machine cannot carry that number; None if
               it can
    missing_s  planner -> since when it has been missing
    started_s  planner -> when it was started here last
    refused    planners that could not be started
    reported   reason why planners are not started, as it was printed last
    """

    scenario: Scenario
    swarm: LocalSwarm
    ranks: Collection[int]
    own: Collection[ProcessSpec]
    is_whole: bool
    say: Callable[[str], None]
    no_room: Callable[[int], str | None]
    missing_s: dict[str, float] = field(default_factory=dict)
    started_s: dict[str, float] = field(default_factory=dict)
    refused: set[str] = field(default_factory=set)
    reported: str = ""

    def follow_orders(self, book: OrderBook, alive: Collection[tuple[str, str]], now_s: float) -> None:
        """Starts missing planners, and ends unwanted ones.

        alive  (role, id) of the processes that are up, anywhere
        """
        targets = book.targets(self.scenario)
        usual = set(self.scenario.target_ids)
        wanted = {ranked_id(id, rank) for id in targets if id not in usual for rank in self.ranks}
        here = {running.spec.id for running in self.swarm.running if running.spec.role == "planner"}
        for id in here:
            if job_of(id) not in targets:
                self.swarm.dismiss(ProcessSpec("planner", id, added=True))
        due = []
        for id in sorted(wanted - here - self.refused):
            if ("planner", id) in alive:
                self.missing_s.pop(id, None)
            elif now_s - self.missing_s.setdefault(id, now_s) >= (0.0 if self.is_whole else LEAVES_TO_OTHERS_S):
                due.append(id)
        begin = [id for id, since_s in self.started_s.items() if now_s - since_s < _BEGINS_WITHIN_S]
        free = _BEGIN_AT_ONCE - sum(("planner", id) not in alive for id in begin)
        for id in due[: max(free, 0)]:
            if (reason := self.no_room(len(wanted & here) + 1)) is not None:
                if reason != self.reported:
                    more = f" and {len(due) - 1} more" if len(due) > 1 else ""
                    self.say(f"planner-{id}{more}: not started: {reason}")
                self.reported = reason
                break
            here.add(id)
            self.started_s[id] = now_s
            self._start(id)
        # One that the scenario has, and that was removed, is wanted again when its removal is taken back.
        ordered = {order.name for order in book if order.subject == "target"} & set(targets)
        for spec in self.own:
            if spec.role == "planner" and job_of(spec.id) in ordered and spec.id not in here:
                self._start(spec.id)

    def _start(self, id: str) -> None:
        try:
            self.swarm.add(ProcessSpec("planner", id, added=True))
        except SwarmError as error:
            self.refused.add(id)
            self.say(f"planner-{id}: {error}")
            return
        self.missing_s.pop(id, None)
        self.say(f"planner-{id} starts: its target was added")


def with_target(scenario: Scenario, book: OrderBook, id: str) -> Scenario:
    """The scenario with a target that was added, for the process that plans for it."""
    added = book.targets(scenario).get(id)
    if added is None or id in scenario.target_ids:
        return scenario
    return msgspec.structs.replace(scenario, targets=(*scenario.targets, added))
