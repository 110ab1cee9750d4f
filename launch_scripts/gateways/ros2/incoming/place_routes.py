"""Routes to places: a target that stands for the goal is put there, and its planner asked until it goes by it."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence

from launch_scripts.gateways.ros2.incoming.readings import Place
from launch_scripts.gateways.ros2.incoming.work_queue import WorkQueue
from swarm.client import BusError, Route, Swarm, SwarmError, Target

TRACKER = "ros2"
"""Name of the tracker that the gateway is: its next start takes its targets over at once."""
PATIENCE_S = 5.0
_AT_ONCE = 6
"""Questions that follow each other without waiting; later ones wait for a tick, as planners go by ticks, too."""
_TICK_S = 0.02
MOST_WAITING = 64
_THREADS = 16
"""A route takes milliseconds; only one to a location where no vehicle can be takes as long as `PATIENCE_S`."""
Answer = Callable[[Route | str], None]
"""Takes a route, or the reason why there is none. Called on a thread of the queue, or at once."""


class PlaceRoutes:
    """A few external targets, lent to those who need a route to a place. One serves all who go to the same cell.

    An unused target stays where it is, so that its tree can be reused for the next request to that location.

    goal_targets  their ids
    queue         does the waiting for planners
    """

    def __init__(self, swarm: Swarm, goal_targets: Sequence[str], queue: WorkQueue | None = None) -> None:
        self._swarm = swarm
        self._cells: dict[str, int | None] = dict.fromkeys(goal_targets)
        """Cell of each; None before its first use."""
        self._users: Counter[str] = Counter()
        self._targets: dict[str, Target] = {}
        self._lock = threading.Lock()
        self._queue = queue or WorkQueue("ros2-routes", _THREADS, MOST_WAITING)

    def lend(self, goal: Place) -> str:
        """Returns a target that stands at a goal from now on, until it is given back. Raises SwarmError if none is
        free, or it cannot be put there."""
        cell = self._swarm.frame.cell(goal.x_m, goal.y_m)
        with self._lock:
            there = [id for id, at in self._cells.items() if at == cell]
            free = [id for id in self._cells if not self._users[id]]
            if not self._cells:
                raise SwarmError("no goal_targets are set, so no place can be a goal")
            if not there and not free:
                raise SwarmError(f"all goal targets are in use: {', '.join(self._cells)}")
            id = (there or free)[0]
            if not there:
                if id not in self._targets:
                    self._targets[id] = self._swarm.target(id, tracker=TRACKER)
                self._targets[id].at(goal.x_m, goal.y_m)
                self._cells[id] = cell
            self._users[id] += 1
            return id

    def give_back(self, target: str) -> None:
        """Returns a target to the pool."""
        with self._lock:
            self._users[target] -= 1

    def to_target(
        self, target: str, start: Place, vehicle_class: str, answer: Answer, cell: int | None = None
    ) -> None:
        """Finds the route to a target: wherever it is, or to the cell where it was put."""

        def find() -> None:
            answer(self._find(target, cell, start, vehicle_class))

        if not self._queue.give(f"a route to {target}", find, answer):
            answer(f"{MOST_WAITING} questions wait already")

    def to_place(self, goal: Place, start: Place, vehicle_class: str, answer: Answer) -> None:
        """Finds the route to a place; no target is lent for it."""

        def find() -> None:
            ends = (start.x_m, start.y_m), (goal.x_m, goal.y_m)
            answer(self._swarm.route(*ends, vehicle_class=vehicle_class, timeout_s=PATIENCE_S))

        if not self._queue.give("a route to a place", find, answer):
            answer(f"{MOST_WAITING} questions wait already")

    def close(self) -> None:
        """Answers what waits."""
        self._queue.close()

    def _find(self, target: str, cell: int | None, start: Place, vehicle_class: str) -> Route | str:
        """Waits for its planner. Raises SwarmError."""
        until_s, asked = time.monotonic() + PATIENCE_S, 0
        while True:
            left_s = max(until_s - time.monotonic(), 0.1)
            question = self._swarm.route_soon(
                target, start.x_m, start.y_m, vehicle_class=vehicle_class, timeout_s=left_s
            )
            try:
                route = question.result()
            except BusError as error:
                why = f"{error}: is it a target of the scenario?"
            else:
                if cell in (None, route.target_cell):
                    return route
                why = f"the planner of {target} finds no path to the goal: no vehicle may be there"
            if time.monotonic() >= until_s:
                return why
            asked += 1
            if asked >= _AT_ONCE:
                time.sleep(_TICK_S)
