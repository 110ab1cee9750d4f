"""The strategies by which a tree follows its target: one table, a row per strategy, in the terms of the paper.

A row gives the search after a move of the target, its width, the condition of a full search, and the thinning of
far cells. `TargetTree` and `Planner` ask the row that is in force and compare no names: a new strategy is a row
here, and its name in `swarm.config.scenario.Strategy`, or a plug-in. Sections are those of Wan et al.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from enum import Enum
from functools import partial
from typing import Literal, Protocol

from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec
from swarm.plugins import Guard, Nonsense, OnFault, Plugin

AHEAD = 16
"""A window reaches this multiple of the target's distance since the last one as wide."""


class OnMove(Enum):
    """Search after a move of the target."""

    WHOLE_TREE = "whole tree"
    """Brute force, section 3.3.1: the exact tree, with every move."""
    EXACT_MOVE = "exact move"
    """Ours: the exact tree, with every move, from the one that there is: a small window around the old and the new
    root, then every cost along the parents, and the few cells that a better neighbour has now."""
    BLOCK_WINDOW = "block window"
    """Variable range, section 3.3.2: a window around the target, as wide as the largest block of 2**k cells whose
    border the target crossed."""
    SCHEDULED_WINDOW = "scheduled window"
    """Ours: windows of doubling width, each searched again once the target has moved by a 16th of its reach."""


@dataclass(frozen=True, slots=True)
class StrategyRow:
    """One strategy.

    renews_within_budget  full searches at the rate of `planner.cpu_budget`, if windows cannot be searched. If
                          False, only when a vehicle whose route ran out asks (section 3.3.2, the passive strategy)
    thins_far_cells     section 3.3.3, multi-resolution: far from the target only the ways between blocks of 16,
                        32, ... cells are grown, a stride that doubles with the distance. Scheduled windows reach a
                        16th of the map's side then: what lies beyond belongs to the strides
    stops_at_askers     a growth for a move goes only as far as the farthest asker, which is "as fast as a
                        single-path planning procedure from the target to the farthest vehicle" (section 3.3.1).
                        With exact moves, while that takes less time
    renews_loose_bounds a served route whose certified gap exceeds `planner.MAX_GAP` asks for a full growth; the
                        strategies of the paper never do
    """

    on_move: OnMove
    renews_within_budget: bool = False
    thins_far_cells: bool = False
    renews_loose_bounds: bool = False
    stops_at_askers: bool = False

    @property
    def is_exact(self) -> bool:
        """True if the tree is exact after every move."""
        return self.on_move in (OnMove.WHOLE_TREE, OnMove.EXACT_MOVE)

    def row(self, growths: Growths) -> StrategyRow:
        """Itself: a strategy of one row."""
        return self


@dataclass(frozen=True, slots=True)
class Growths:
    """Inputs of a strategy's choice.

    full_ns       CPU time that a full growth takes: a model's figure until one has been measured
    budget_ns     CPU time that a tick may take, by `planner.cpu_budget`
    widest_cells  how far the widest window reaches that is grown without a worker
    map_cells     cells of the map
    exact_ns      CPU time that an exact move takes: in proportion to `full_ns` until one has been measured; inf
                  where it would hold up answers for long
    moves_per_tick  how often the target has moved lately; 1 until known
    """

    full_ns: float
    budget_ns: float
    widest_cells: int
    map_cells: int
    exact_ns: float
    moves_per_tick: float = 1.0


class Strategy(Protocol):
    """Says what a planner grows. A plug-in is made as `Name(world: StrategyWorld, options)`, or a `StrategyRow`."""

    def row(self, growths: Growths) -> StrategyRow:
        """The row in force from now on. Asked at the start, and whenever one of these has changed."""
        ...


@dataclass(frozen=True, slots=True)
class StrategyWorld:
    """Arguments with which a strategy is made.

    target  id of the planner's target
    config  the planner's settings
    """

    target: str
    grid: GridSpec
    config: PlannerConfig


ROWS: Mapping[str, StrategyRow] = {
    "full": StrategyRow(OnMove.WHOLE_TREE, stops_at_askers=True),
    "exact": StrategyRow(OnMove.EXACT_MOVE),
    "variable_range": StrategyRow(OnMove.BLOCK_WINDOW),
    "multi_resolution": StrategyRow(OnMove.SCHEDULED_WINDOW, thins_far_cells=True),
    "variable_range+multi_resolution": StrategyRow(OnMove.BLOCK_WINDOW, thins_far_cells=True),
}
"""Every strategy of one row; `auto` goes through those of `STAGES`."""

Stage = Literal["exact", "rotate"]

STAGES: Mapping[Stage, StrategyRow] = {
    "exact": StrategyRow(OnMove.EXACT_MOVE, renews_loose_bounds=True, stops_at_askers=True),
    "rotate": StrategyRow(OnMove.SCHEDULED_WINDOW, renews_within_budget=True, renews_loose_bounds=True),
}
"""`auto`: exact moves while one fits into a tick; then windows, with exact trees in turn
(docs/method/paper.md says why no strides)."""

HYSTERESIS = 0.7
"""`auto` returns to the better stage only below this share of the budget: times are noisy."""


class Auto:
    """Chooses the stage of `auto` from observed times alone, so that a model decides alike everywhere.

    stage  what to do now; `row` alone changes it
    """

    def __init__(self) -> None:
        self.stage: Stage = "exact"

    def row(self, growths: Growths) -> StrategyRow:
        slowest_ns = growths.budget_ns / max(growths.moves_per_tick, 1e-9)
        exact = growths.exact_ns <= slowest_ns * (1.0 if self.stage == "exact" else HYSTERESIS)
        self.stage = "exact" if exact else "rotate"
        return STAGES[self.stage]


STRATEGIES: Mapping[str, Callable[[], Strategy]] = {
    "auto": Auto,
    **{name: partial(replace, row) for name, row in ROWS.items()},
}
"""Every built-in strategy."""


def strategy_of(plugin: Plugin, world: StrategyWorld, report: OnFault) -> Strategy:
    """The strategy that a scenario names. Raises ConfigError if it cannot be made; `report` is called with a later
    fault."""
    if plugin.factory is None:
        return STRATEGIES[plugin.named.name]()
    return PluginStrategy(plugin.make(world), Guard(plugin, report))


class PluginStrategy:
    """The rows of a plug-in; exact moves once it has failed."""

    def __init__(self, strategy: Strategy, guard: Guard) -> None:
        self._strategy = strategy
        self._guard = guard

    def row(self, growths: Growths) -> StrategyRow:
        return self._guard.ask(lambda: self._strategy.row(growths), _checked, lambda: STAGES["exact"])


def _checked(row: object) -> StrategyRow:
    if type(row) is not StrategyRow:
        raise Nonsense(f"{type(row).__name__}, expected a StrategyRow")
    for field in fields(StrategyRow):
        wanted, found = type(getattr(STAGES["exact"], field.name)), getattr(row, field.name)
        if type(found) is not wanted:
            raise Nonsense(f"a StrategyRow whose {field.name} is {found!r}, expected a {wanted.__name__}")
    return row


def whole_trees_only(row: StrategyRow) -> StrategyRow:
    """A row until other kernels are compiled: only whole trees are grown."""
    return StrategyRow(OnMove.WHOLE_TREE, renews_loose_bounds=row.renews_loose_bounds)
