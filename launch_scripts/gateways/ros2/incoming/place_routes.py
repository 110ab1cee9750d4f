"""Routes to places: a target that stands for the goal is put there, and its planner asked until it goes by it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass

from launch_scripts.gateways.ros2.incoming.goals import GoalTargets
from launch_scripts.gateways.ros2.incoming.places import Place
from swarm.client import Route, Swarm, SwarmError, Target
from swarm.clock import NS_PER_S

TRACKER = "ros2"
"""Name of the tracker that the gateway is: its next start takes its targets over at once."""
PATIENCE_S = 5.0
_AT_ONCE = 6
"""Questions that follow each other without waiting; later ones wait for a tick, as planners go by ticks, too."""
MOST_WAITING = 64
Answer = Callable[[Route | str], None]
"""Takes a route, or the reason why there is none. Called on a thread of the swarm's connection, or at once."""


@dataclass
class _Question:
    target: str
    cell: int | None
    start: Place
    vehicle_class: str
    until_ns: int
    answer: Answer
    asked: int = 0


class PlaceRoutes:
    """Asks without waiting. Any thread may call.

    goal_targets  external targets of the scenario that stand for goals
    """

    def __init__(self, swarm: Swarm, goal_targets: Sequence[str]) -> None:
        self._swarm = swarm
        self._pool = GoalTargets(goal_targets)
        self._targets: dict[str, Target] = {}
        self._lock = threading.Lock()
        self._later: list[_Question] = []
        self._waiting = 0

    def lend(self, goal: Place) -> str | None:
        """A target that stands at a goal from now on, until it is given back; None if none is free. Raises
        SwarmError if it cannot be put there."""
        cell = self._swarm.frame.cell(goal.x_m, goal.y_m)
        with self._lock:
            lent = self._pool.lend(cell)
            if lent is None:
                return None
            id, there = lent
            try:
                if id not in self._targets:
                    self._targets[id] = self._swarm.target(id, tracker=TRACKER)
                if not there:
                    self._targets[id].at(goal.x_m, goal.y_m)
            except SwarmError:
                self._pool.give_back(id)
                raise
            return id

    def give_back(self, target: str) -> None:
        """What was lent is needed no more."""
        with self._lock:
            self._pool.give_back(target)

    @property
    def none_free(self) -> str:
        """Why nothing was lent, in a sentence."""
        ids = ", ".join(self._pool.ids)
        return (
            f"all goal targets are in use: {ids}" if ids else "no goal_targets are set, so no place can be a goal"
        )

    def to_target(self, target: str, start: Place, vehicle_class: str, answer: Answer) -> None:
        """The route to a target, wherever it is."""
        self._begin(target, None, start, vehicle_class, answer)

    def to_lent(self, target: str, start: Place, vehicle_class: str, answer: Answer) -> None:
        """The route to where a target was put that is lent."""
        with self._lock:
            cell = self._pool.cell_of(target)
        self._begin(target, cell, start, vehicle_class, answer)

    def to_place(self, goal: Place, start: Place, vehicle_class: str, answer: Answer) -> None:
        """The route to a place; the target that stands for it is given back with the answer."""
        try:
            lent = self.lend(goal)
        except SwarmError as error:
            answer(str(error))
            return
        if lent is None:
            answer(self.none_free)
            return

        def give_back(found: Route | str) -> None:
            self.give_back(lent)
            answer(found)

        self.to_lent(lent, start, vehicle_class, give_back)

    def tick(self) -> None:
        """Ask again what planners had not come to."""
        with self._lock:
            later, self._later = self._later, []
        for question in later:
            self._ask(question)

    def close(self) -> None:
        """Answer what waits, and let all targets go."""
        with self._lock:
            later, self._later = self._later, []
            targets, self._targets = list(self._targets.values()), {}
        for question in later:
            self._end(question, "the gateway ends")
        for target in targets:
            target.leave()

    def _begin(self, target: str, cell: int | None, start: Place, vehicle_class: str, answer: Answer) -> None:
        with self._lock:
            full = self._waiting >= MOST_WAITING
            self._waiting += not full
        if full:
            answer(f"{MOST_WAITING} questions wait already")
            return
        until_ns = time.monotonic_ns() + int(PATIENCE_S * NS_PER_S)
        self._ask(_Question(target, cell, start, vehicle_class, until_ns, answer))

    def _ask(self, question: _Question) -> None:
        left_s = (question.until_ns - time.monotonic_ns()) / NS_PER_S
        start = question.start
        question.asked += 1
        try:
            asked = self._swarm.route_soon(
                question.target, start.x_m, start.y_m, vehicle_class=question.vehicle_class,
                timeout_s=max(left_s, 0.1),
            )  # fmt: skip
        except SwarmError as error:
            self._end(question, str(error))
            return
        asked.add_done_callback(lambda done: self._hear(question, done))

    def _hear(self, question: _Question, done: Future[Route]) -> None:
        error = done.exception()
        route = None if error is not None else done.result()
        if route is not None and question.cell in (None, route.target_cell):
            self._end(question, route)
        elif time.monotonic_ns() >= question.until_ns:
            no_way = f"the planner of {question.target} finds no way to the goal: nobody may stand there"
            self._end(question, no_way if error is None else f"{error}: is it a target of the scenario?")
        elif error is None and question.asked < _AT_ONCE:
            self._ask(question)
        else:
            with self._lock:
                self._later.append(question)

    def _end(self, question: _Question, found: Route | str) -> None:
        with self._lock:
            self._waiting -= 1
        question.answer(found)
