"""Random checks of what planners say of their routes: rules, strategies and lives, against an independent oracle.

A life is one tree over a small random map: its target steps and jumps, marks come and go, a worker's growths are
adopted late, some routes are asked for in between. After each event every cell's route is checked.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import get_args

import numpy as np
from support.planner_play import LAWS as LAWS
from support.planner_play import Play, Seconds
from support.planner_strategies import RULES, Job, Marks, Move, random_climb, random_pace
from support.slow_twins import Cells

from planner_service.kernel_build import load_all
from swarm.config.scenario import PlannerConfig, Strategy
from swarm.grid import GridSpec
from swarm.wire.route_columns import OK, RouteBatch


@dataclass
class Findings:
    """The findings of a campaign.

    checks      routes checked, whole ones and cut ones each
    violations  by law
    worst       by law, relative; how far the worst one is off
    example     by law: the seed of the first life that broke it
    stated      worst relative difference of a stated cost from the driven cost, whole or cut, allowed or not
    """

    checks: int = 0
    lives: int = 0
    violations: dict[str, int] = field(default_factory=lambda: dict.fromkeys(LAWS, 0))
    worst: dict[str, float] = field(default_factory=dict)
    example: dict[str, int] = field(default_factory=dict)
    stated: float = 0.0

    def note(self, law: str, off: Seconds, allowed: float, seed: int) -> None:
        """Counts those of `off` (relative) that are more than allowed, or no number."""
        broken = ~(off <= allowed)
        many = int(np.count_nonzero(broken))
        if many:
            self.violations[law] += many
            self.worst[law] = max(self.worst.get(law, 0.0), float(np.nan_to_num(off[broken], nan=math.inf).max()))
            self.example.setdefault(law, seed)
        if law in ("stated", "cut"):
            self.stated = max(self.stated, float(off.max(initial=0.0)))


def lives(seed: int) -> Iterator[Findings]:
    """The findings after each history, without end. Each life has a seed of its own, counted up from `seed`: a
    violation's is named, and lives from it on begin with it."""
    load_all()
    findings = Findings()
    while True:
        Life(seed + findings.lives, findings).live()
        findings.lives += 1
        yield findings


class Life:
    """One tree, its map, and a worker's growth that it may wait for."""

    def __init__(self, seed: int, findings: Findings) -> None:
        self._seed = seed
        self._findings = findings
        rng = self._rng = np.random.default_rng(seed)
        in_pieces = bool(rng.random() < 0.25)
        rows, cols = (int(rng.integers(1, 161 if in_pieces else 49)) for _ in "rc")
        resolution_m = float(rng.choice([1.0, 0.1, 7.3, 30.0]))
        self._grid = GridSpec(rows, cols, resolution_m)
        ratio, walls = float(rng.choice([1.0, 3.0, 100.0, 1e4, 1e8])), float(rng.choice([0.0, 0.1, 0.3, 0.5]))
        pace = self._pace = random_pace(rng, rows, cols, ratio, walls)
        kind = int(rng.integers(2 if in_pieces else 3))
        relief_m, steepest = rng.choice([0.0, 0.1, 0.5]) * resolution_m, float(rng.choice([0.1, 0.3, 10.0]))
        self._climb = random_climb(rng, self._grid, relief_m, steepest) if kind == 2 else None
        self.config = PlannerConfig(
            strategy=str(rng.choice(["exact", "auto"] if in_pieces else get_args(Strategy))),
            k_min=int(rng.integers(3)),
            cpu_budget=float(rng.choice([1e-9, 1e-4, 0.5])),
            length_weight=float(10.0 ** rng.uniform(-6, 6)) if kind == 1 else 0.0,
            **RULES[rng.integers(len(RULES))],
        )
        target = int(rng.choice(np.flatnonzero(np.isfinite(pace))))
        self._play = Play(pace, self.config, climb=self._climb, grid=self._grid, target=target, in_pieces=in_pieces)
        self._tree = self._play.tree

    def live(self) -> None:
        rng, play = self._rng, self._play
        self._check()
        for _ in range(int(rng.integers(4, 25))):
            event = rng.random()
            if event < 0.65:
                most = 1 if event < 0.55 else 16
                play.happen(Move(*rng.integers(-most, most + 1, 2).tolist()))
            elif event < 0.8:
                play.happen(Marks(int(rng.integers(1 << 31)), int(rng.integers(1, 7))))
            elif event < 0.9:
                play.happen(Job("begin" if play.grown is None else "end"))
            elif event < 0.95:
                self._tree.force(self._some(3))
            else:
                self._tree.routes(self._some(5), int(rng.integers(9)))
                self._tree.cost_to_go_at(self._some(5))
            self._check()

    def _some(self, most: int) -> Cells:
        return self._rng.integers(self._grid.cells, size=int(self._rng.integers(1, most + 1)))

    def _check(self) -> None:
        if not self._tree.ready:
            return
        every = np.arange(self._grid.cells)
        if self._rng.random() < 0.5:  # what a cut route says must not need the whole one to have been asked for
            cut = self._tree.routes(every, int(self._rng.integers(1, 12)))
            whole = self._tree.routes(every)
        else:
            whole = self._tree.routes(every)
            cut = self._tree.routes(every, int(self._rng.integers(1, 12)))
        self._findings.checks += 2 * every.size
        for law, off, allowed in self._play.measured(self._play.best_s(), whole, cut):
            self._note(law, off, allowed)
        self._check_alone(whole, cut, np.flatnonzero((whole.statuses == OK) & (cut.statuses == OK)))

    def _check_alone(self, whole: RouteBatch, cut: RouteBatch, there: Cells) -> None:
        if not there.size:
            return
        cell = int(self._rng.choice(there))
        steps = int(np.diff(cut.ends, prepend=0).max())
        for many, alone in ((whole, self._tree.routes([cell])), (cut, self._tree.routes([cell], steps))):
            same = many[cell] == alone[0]
            self._note("batch", np.array([0.0 if same else abs(alone[0].cost_s / many[cell].cost_s - 1)]), 0.0)
            if not same:
                self._note("batch", np.array([math.inf]), 0.0)

    def _note(self, law: str, off: Seconds, allowed: float) -> None:
        self._findings.note(law, off, allowed, self._seed)
