"""Planning without a network: from an array of paces to routes with their certificates."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planner_service.any_angle_routes import Puller
from planner_service.goal_tree_cache import GoalTrees
from planner_service.strategy import STRATEGIES
from planner_service.target_tree import TargetTree
from planner_service.tree.cost_grid import CostGrid
from shared_map.terrain.slope_and_climb import Climb
from swarm.config.explain import check_keywords, choice, converted
from swarm.config.scenario import PlannerConfig
from swarm.errors import ArgumentError
from swarm.grid import GridSpec, Window, brief, real, walk, whole
from swarm.wire.route_columns import Route, RouteStatus, TargetStatus, directions_of

_KEPT_BYTES = 1 << 28
"""Memory of the trees that `RouteFinder.between` keeps."""


@dataclass(frozen=True, slots=True, eq=False)
class FoundRoute:
    """A route from a cell to the target, or why there is none.

    status         "ok", or "unreachable", "outside", "lethal_start", "lethal_target"
    cells          int64 (steps + 1, 2), row and col of every cell from the start to the target; the start alone
                   where there is no route
    cost_s         s, the driving time; inf if there is no route
    lower_bound_s  s; no route from there to the target takes less, which is proven
    length_m       m
    """

    status: RouteStatus | TargetStatus
    cells: NDArray[np.int64]
    cost_s: float
    lower_bound_s: float
    length_m: float

    @property
    def gap(self) -> float:
        """Cost over proven lower bound: 1 is proven to be optimal, 1.05 is at most 5 % above the optimum."""
        return max(self.cost_s / self.lower_bound_s, 1.0) if self.lower_bound_s > 0 else np.inf


@dataclass(frozen=True, slots=True, eq=False)
class PulledRoute:
    """A route of straight segments between centres of cells that a route over neighbours passes.

    Both costs are integrals of the pace along the way, where half of a step lies in the cell that it leaves; those
    of a flight hold what it climbs, and the wind. `FoundRoute.cost_s` prices a step by the cell that it enters, and
    its lower bound holds for routes over neighbours alone: a pulled route may cost less than it.

    turns        int64 (n, 2), row and col of the cells where it turns, with the start and the target
    cost_s       s, along the segments; never more than `grid_cost_s`
    grid_cost_s  s, along the route over neighbours
    length_m     m, of the segments
    """

    turns: NDArray[np.int64]
    cost_s: float
    grid_cost_s: float
    length_m: float


class RouteFinder:
    """Cheapest routes from everywhere to one target, kept up to date as the target moves and the map changes.

    Parameters
    ----------
    pace : array_like (rows, cols), s/m
        Seconds that a metre takes in each cell; inf is lethal. It is copied.
    target : (row, col), optional
        Where all routes of `route` lead. On a lethal cell, or without one, there is no route; outside the grid
        raises OutsideGridError. `between` needs none.
    resolution_m : float
        Side of a cell.
    climb : Climb, optional
        What a step costs for what it climbs, where uphill is not downhill.
    **settings
        Fields of `PlannerConfig`, such as ``strategy`` (here "full" unless given), ``edge``, ``corner_cutting``.

    Raises
    ------
    ConfigError
        On a setting that does not exist, or may not have this value.
    ArgumentError
        A ConfigError, ValueError and TypeError: on a pace that is NaN, zero or negative, masked or true, an array
        without two dimensions, an unknown strategy, a row or column that is no whole number, a resolution that is
        none, or a climb of another type.
    """

    def __init__(
        self,
        pace: Any,
        target: tuple[int, int] | None = None,
        *,
        resolution_m: float = 1.0,
        climb: Climb | None = None,
        **settings: Any,
    ) -> None:
        self._pace = _paces(pace)
        if self._pace.ndim != 2:
            raise ArgumentError(f"pace has {self._pace.ndim} dimensions, expected 2")
        rows, cols = self._pace.shape
        self.grid = GridSpec(rows, cols, real("resolution_m", resolution_m))
        _check_type("climb", climb, Climb | None)
        own = (*PlannerConfig.__struct_encode_fields__, "target", "resolution_m", "climb")
        check_keywords(settings, own, "RouteFinder")
        self._config = converted({"strategy": "full", **settings}, PlannerConfig, "RouteFinder", "settings")
        if (strategy := self._config.strategy) not in STRATEGIES:
            raise ArgumentError(f"strategy: found {strategy!r}{choice(strategy, tuple(STRATEGIES))}")
        self._climb = climb
        self._tree = TargetTree(self.grid, self._config, climb)
        self._goals: GoalTrees | None = None
        self._version = 0
        self._target = None if target is None else self.grid.cell(*_whole(target))
        self._update([])

    def move(self, target: tuple[int, int]) -> None:
        """Moves the target to a cell (row, col). Raises OutsideGridError, and changes nothing, outside the grid."""
        self._target = self.grid.cell(*_whole(target))
        self._update([])

    def change(self, pace: Any, row: int = 0, col: int = 0) -> None:
        """Replaces paces: `pace` is a (height, width) block in s/m, whose north-west cell is (row, col).

        Raises ArgumentError, and changes nothing, on a block that leaves the grid or a pace that is not positive.
        """
        row, col = _whole((row, col))
        block = np.atleast_2d(_paces(pace))
        window = Window(row, col, row + block.shape[0], col + block.shape[1])
        if block.ndim != 2 or row < 0 or col < 0 or window.row1 > self.grid.rows or window.col1 > self.grid.cols:
            place = f"rows {row} to {window.row1 - 1} and columns {col} to {window.col1 - 1}"
            raise ArgumentError(f"{place} are not inside {self.grid.rows} x {self.grid.cols} cells")
        self._pace[row : window.row1, col : window.col1] = block
        self._version += 1
        if self._goals is not None:
            self._goals.changed(self._goals.costs.apply(self._pace, [window]))
        self._update([window])

    def route(self, row: int, col: int | None = None) -> FoundRoute:
        """The cheapest route that is known from a cell, with its proven lower bound. Outside is a status. Raises
        ArgumentError unless both are whole numbers."""
        row, col = _whole((row, col))
        cell = self.grid.cell(row, col) if self.grid.inside(row, col) else -1
        found: Route = self._tree.routes([cell])[0]
        lethal = found.status is RouteStatus.NO_TARGET and self._tree.lethal_target is not None
        return self._found((row, col), found, lethal)

    def _found(self, start: tuple[int, int], route: Route, lethal_target: bool) -> FoundRoute:
        cells = np.array([start], np.int64)
        if route.status is RouteStatus.OK:
            crossed = np.array(walk(self.grid, route.start, route.directions))
            cells = np.stack(np.divmod(crossed, self.grid.cols), axis=1)
        status = TargetStatus.LETHAL if lethal_target else route.status
        return FoundRoute(status, cells, route.cost_s, route.lower_bound_s, route.length_m)

    def between(self, start: tuple[int, int], goal: tuple[int, int]) -> FoundRoute:
        """The cheapest route between any two cells, whatever the target is.

        Parameters
        ----------
        start, goal : (row, col)
            Whole numbers. Outside the grid is a status.

        The search grows from the goal as far as the start is, and its tree is kept for the next start. Where uphill
        is not downhill, or where the costliest cell costs some 2,900 times the cheapest, it grows over all of the
        map. Costs are in s, lengths in m, with the same meaning as of `route`.
        """
        start, goal, grid = _whole(start), _whole(goal), self.grid
        if self._goals is None:
            costs = CostGrid(self.grid, self._config, self._climb)
            costs.load(self._pace)
            self._goals = GoalTrees(costs, _KEPT_BYTES)
        at, to = (grid.cell(*end) if grid.inside(*end) else -1 for end in (start, goal))
        found = self._goals.ask(to, at, grid.cells)
        return self._found(start, found.route, found.lethal_goal)

    def pull(self, route: FoundRoute) -> PulledRoute:
        """A route pulled straight: fewer turns, less time, no lethal cell and no corner that its steps may not cut.

        The cheapest chain of segments between the route's own cells, by dynamic programming over some of them:
        those up to 64 cells back, with growing gaps, and the turn before.

        Raises ArgumentError where uphill is not downhill on the ground, on a route that does not lead to a target,
        on one that the map's changes have shut, and on anything else.
        """
        _check_type("route", route, FoundRoute)
        if route.status is not RouteStatus.OK:
            raise ArgumentError(f"route is {route.status.value!r}, expected 'ok': no other is pulled")
        at = route.cells @ np.array((self.grid.cols, 1), np.int64)
        codes = np.frombuffer(bytearray(directions_of(at, self.grid.cols)), np.uint8)
        pulled, prices = self._puller.pull(at[:1], codes, np.array([codes.size]))
        if not np.isfinite(prices[0, 0]):
            raise ArgumentError("the route passes a cell or a corner that is shut by now: ask for it again")
        crossed = np.array(walk(self.grid, int(at[0]), pulled.directions.tobytes()))
        ends = np.concatenate(((0,), np.cumsum(pulled.legs, dtype=np.int64)))
        turns = np.stack(np.divmod(crossed[ends], self.grid.cols), axis=1)
        cost_s, grid_cost_s, length_m = prices[:, 0].tolist()
        return PulledRoute(turns, cost_s, grid_cost_s, length_m)

    @cached_property
    def _puller(self) -> Puller:
        return Puller(self._pace, self.grid.resolution_m, self._config, self._climb)

    def cost_to_go_s(self) -> NDArray[np.float32]:
        """(rows, cols) float32, s: what driving to the target takes from every cell; inf where there is no path."""
        costs: NDArray[np.float32] = self._tree.cost_to_go_at(np.arange(self.grid.cells))
        return costs.reshape(self.grid.rows, self.grid.cols)

    def _update(self, dirty: list[Window]) -> None:
        tree, pace = self._tree, self._pace
        if self._target is None:
            return
        update = tree.update(pace, self._target, dirty, self._version)
        if update.wants_full:
            tree.adopt(tree.full_job(self._target)(), pace, self._target, [], self._version, [])
        if tree.wants_strides:
            tree.take_strides(tree.stride_job()())


def _check_type(name: str, value: object, kind: Any) -> None:
    """Raises ArgumentError unless a value is of this type."""
    if not isinstance(value, kind):
        raise ArgumentError(f"{name} is {brief(value)}, expected {getattr(kind, '__name__', kind)}")


def _whole(place: Any) -> tuple[int, int]:
    """A place as (row, col). Raises ArgumentError unless both are whole numbers of at most 64 bits. Nothing is
    rounded: the next row may lie on the other side of a wall."""
    try:
        row, col = map(int, np.array([whole("row or column", each) for each in place], np.int64))
    except (TypeError, ValueError, OverflowError) as error:
        raise ArgumentError(f"{brief(place)} is no cell, which is two whole numbers, such as 1, 1") from error
    return row, col


def _paces(given: Any) -> NDArray[np.float32]:
    """A copy of paces. Raises ArgumentError where one is no number above 0; what only float32 makes inf is none."""
    values = np.array(None)
    with suppress(ValueError):  # rows of different lengths
        values = np.asanyarray(given)
    if values.dtype.kind not in "iuf" or np.ma.is_masked(values):
        raise ArgumentError(
            f"pace is {values.dtype}, or masked in part; expected numbers, and inf where it is lethal"
        )
    with np.errstate(over="ignore"):
        paces = np.array(values, np.float32, order="C")
    wrong = ~(paces > 0) | (np.isinf(paces) & np.isfinite(values))
    if wrong.any():
        raise ArgumentError(
            f"a pace is {values[wrong][0]:g} s/m, expected 1e-38 to 3e+38, or inf where it is lethal"
        )
    return paces
