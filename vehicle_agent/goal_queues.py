"""Goals of an agent's vehicles: the places to which operators sent them, one after the other.

`VehicleGoals.done` is the whole progress of a vehicle. It grows by one when the vehicle is at rest at its place.
The agent tells it, and keepers store it: a later generation of the agent goes on where this one ended. Pure.

A place that several vehicles share counts as reached on the nearest cells, one per vehicle. Otherwise all but one
would push for ever.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

from msgspec.structs import replace

from swarm.runtime.order_book import MOST_SENT, GoalBook
from swarm.wire.messages.orders import GoalState, GoalStateName, VehicleGoals
from swarm.wire.messages.vehicles import VehicleState
from swarm.wire.route_columns import RouteStatus
from vehicle_agent.driving.driven_vehicle import Vehicle

NO_PLANNER = "no process plans routes to places"
REASONS: Mapping[str, str] = {
    RouteStatus.UNREACHABLE: "no way leads there",
    RouteStatus.LETHAL_START: "the vehicle is on a lethal cell",
    RouteStatus.OUTSIDE: "the vehicle is outside the map",
    "lethal_goal": "the place is lethal",
    "outside_goal": "the place is outside the map",
}
"""Status of a route, or of all to a place -> why a vehicle is blocked."""


def next_cell(goals: VehicleGoals | None) -> int | None:
    """The place to which a vehicle goes now or which it holds; None if it chases targets."""
    if goals is None or goals.off:
        return None
    count = len(goals.cells)
    if goals.then == "repeat" or goals.done < count:
        return goals.cells[goals.done % count]
    return goals.cells[-1] if goals.then == "hold" else None


def is_over(goals: VehicleGoals) -> bool:
    """Returns True if a vehicle has reached its last place. A loop of one place ends there."""
    ends = goals.then != "repeat" or len(set(goals.cells)) == 1
    return not goals.off and ends and goals.done >= len(goals.cells)


def arrival_cells(goal: int, vehicles: int, steps: Callable[[int], Iterable[int]]) -> frozenset[int]:
    """The cells on which vehicles that share a place reach it: those within the least number of steps from it that
    are as many as the vehicles, or all that can be reached.

    steps  cells to which one may drive from a cell
    """
    found, edge = {goal}, [goal]
    while edge and len(found) < vehicles:
        edge = [*dict.fromkeys(cell for tail in edge for cell in steps(tail) if cell not in found)]
        found.update(edge)
    return frozenset(found)


class GoalQueues:
    """Goals of the vehicles of one agent.

    steps    cells of right of way to which a vehicle may drive from one
    middle   the one in the middle of a cell of the terrain: of a place

    book     where they are sent; the owner merges what keepers tell
    shared   cell -> how many vehicles of all agents were sent there, where it is more than one
    refused  vehicle -> the status with which its last question for a route was refused
    """

    def __init__(self, steps: Callable[[int], Iterable[int]], middle: Callable[[int], int]) -> None:
        self.book = GoalBook()
        self.shared: Mapping[int, int] = {}
        self.refused: dict[str, str] = {}
        self._steps, self._middle = steps, middle
        self._arrivals: dict[int, frozenset[int]] = {}

    def forget_arrivals(self) -> None:
        """The ground, obstacles or shared places may have changed."""
        self._arrivals.clear()

    def cell(self, vehicle: str) -> int | None:
        """The place to which a vehicle goes or which it holds; None if it chases targets."""
        return next_cell(self.book.get(vehicle))

    def is_at(self, vehicle: str, goal: int, cell: int) -> bool:
        """Returns True if a vehicle that rests on a cell has reached a place. On a loop, a cell that counts for the
        place before does not count for this one, too: the vehicle would not move any more."""
        goals, before = self.book.in_force(vehicle), goal
        if goals is not None and goals.then == "repeat":
            before = goals.cells[goals.done % len(goals.cells) - 1]
        return cell == self._middle(goal) or (
            cell in self._near(goal) and (before == goal or cell not in self._near(before))
        )

    def _near(self, goal: int) -> frozenset[int]:
        """The cells on which a vehicle reaches a place."""
        if goal not in self._arrivals:
            vehicles = min(self.shared.get(goal, 1), MOST_SENT)  # whatever is told, the work is bounded
            self._arrivals[goal] = arrival_cells(self._middle(goal), vehicles, self._steps)
        return self._arrivals[goal]

    def reached(self, vehicle: str, goal: int, now_ns: int) -> bool:
        """A vehicle is at rest at the place for which it goes. Returns True if that is news: not if it has no place
        left, or is sent to another by now."""
        goals = self.book.in_force(vehicle)
        if goals is None or is_over(goals) or goal != next_cell(goals):
            return False
        return bool(self.book.merge([replace(goals, done=goals.done + 1)], now_ns))

    def states(
        self,
        vehicles: Mapping[str, Vehicle],
        left: Iterable[str],
        stopped: Callable[[str], bool],
        waiting: Iterable[str],
    ) -> list[GoalState]:
        """The state of each vehicle that was sent somewhere.

        vehicles  those on the map
        left      those that have left it
        stopped   whether an operator lets a vehicle stand
        waiting   those that wait for right of way
        """
        gone, waits = frozenset(left), frozenset(waiting)
        found = []
        for goals in self.book:
            vehicle = vehicles.get(goals.name)
            state: GoalStateName = "underway"
            reason = ""
            if goals.off:
                state = "canceled"
            elif is_over(goals):
                state = "completed"
            elif goals.name in gone:
                state = "failed"
            elif vehicle is None:
                state = "queued"
            elif stopped(vehicle.id):
                state = "standby"
            elif vehicle.state is VehicleState.STRANDED:
                state, refused = "blocked", self.refused.get(vehicle.id, "")
                reason = REASONS.get(refused, refused)
            elif vehicle.planner_gone and not vehicle.route.left:
                state, reason = "blocked", NO_PLANNER
            elif goals.name in waits:
                state = "delayed"
            elif vehicle.state is VehicleState.WAITING:
                state = "queued"
            found.append(GoalState(
                name=goals.name, stamp_ns=goals.stamp_ns, done=goals.done, state=state, cell=next_cell(goals),
                reason=reason,
            ))  # fmt: skip
        return found
