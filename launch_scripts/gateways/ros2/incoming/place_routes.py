"""Questions for routes, to a target or to any place: asked on threads of their own, answered once."""

from __future__ import annotations

from collections.abc import Callable

from launch_scripts.gateways.ros2.incoming.readings import Place
from launch_scripts.gateways.ros2.incoming.work_queue import WorkQueue
from swarm.client import Route, Swarm

PATIENCE_S = 5.0
"""A planner that starts, or grows the tree of a new goal, answers within this time on the demo's terrain."""
MOST_WAITING = 64
_THREADS = 16
"""A route takes milliseconds; only one whose planner is busy or missing takes as long as `PATIENCE_S`."""
Answer = Callable[[Route | str], None]
"""Takes a route, or the reason why there is none. Called on a thread of the queue, or at once."""


class RouteQuestions:
    """Asks planners of targets, and the planner of places."""

    def __init__(self, swarm: Swarm) -> None:
        self._swarm = swarm
        self._queue = WorkQueue("ros2-routes", _THREADS, MOST_WAITING)
        self.close = self._queue.close

    def ask(self, goal: Place | str, start: Place, vehicle_class: str, answer: Answer) -> None:
        """Finds the route to a target, wherever it is, or to a place."""

        def find() -> None:
            if isinstance(goal, str):
                asked = self._swarm.route_soon(
                    goal, start.x_m, start.y_m, vehicle_class=vehicle_class, timeout_s=PATIENCE_S
                )
                answer(asked.result())
            else:
                ends = (start.x_m, start.y_m), (goal.x_m, goal.y_m)
                answer(self._swarm.route(*ends, vehicle_class=vehicle_class, timeout_s=PATIENCE_S))

        if not self._queue.give("a question for a route", find, answer):
            answer(f"{MOST_WAITING} questions wait already")
