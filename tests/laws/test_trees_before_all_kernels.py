"""While only the kernels of a first route are compiled, a tree keeps every law, and calls no other."""

import sys
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.effort import few
from support.planner_play import Play
from support.planner_strategies import STRATEGIES, Job, Marks, Move, happenings, paces, planner_configs, random_pace

from planner_service.kernel_build import FIRST, LATER
from swarm.config.scenario import PlannerConfig


class Guard:
    """Stands for a kernel that is not compiled until `open`."""

    opened = False

    def __init__(self, kernel: Callable[..., object]) -> None:
        self.kernel = kernel

    def __call__(self, *arguments: object) -> object:
        assert Guard.opened, f"{self.kernel} is called before it is compiled"
        return self.kernel(*arguments)


@pytest.fixture(autouse=True)
def guarded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Guards every name in the planner by which one of the later kernels is called."""
    guards = {id(kernel): Guard(kernel) for kernel in LATER}
    found = set()
    for name, module in list(sys.modules.items()):
        if name.startswith("planner_service") and name != "planner_service.kernel_build":
            for key, value in list(vars(module).items()):
                if id(value) in guards:
                    monkeypatch.setattr(module, key, guards[id(value)])
                    found.add(id(value))
    assert found == set(guards)
    Guard.opened = False


@given(paces(), planner_configs(), happenings(), st.integers(0, 10))
@settings(max_examples=few(150), deadline=None)
def test_whatever_happens_before_and_after_the_last_kernel_is_there_keeps_the_laws(
    pace: np.ndarray, config: PlannerConfig, events: list[Move | Marks | Job], opens: int
) -> None:
    Guard.opened = False
    play = Play(pace, config, lambda: Guard.opened)
    play.check()
    for n, event in enumerate(events):
        Guard.opened |= n == opens
        play.happen(event)
        play.check()


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_every_strategy_begins_with_whole_trees_and_goes_on_as_it_would(strategy: str) -> None:
    pace = random_pace(np.random.default_rng(2), 40, 40, 5.0, 0.1)
    config = PlannerConfig(strategy=strategy, k_min=0, cpu_budget=1e-9)  # type: ignore[arg-type]
    play = Play(pace, config, lambda: Guard.opened)
    for event in (Move(1, 1), Job("begin"), Marks(3, 3), Move(1, 0), Job("end"), Job("force"), Move(0, 1)):
        play.happen(event)
        play.check()
        assert play.last.kind in ("full", "bounded", "none")
        assert play.tree.routes(np.arange(play.grid.cells)).gaps.max(initial=1.0) < 1.0001
    Guard.opened = True
    kinds = set()
    for _ in range(8):
        play.happen(Move(1, 0))
        play.check()
        kinds.add(play.last.kind)
    assert (kinds <= {"full", "bounded", "none"}) == (strategy == "full")


def test_no_kernel_is_in_both_lists() -> None:
    assert not {id(kernel) for kernel in FIRST} & {id(kernel) for kernel in LATER}
