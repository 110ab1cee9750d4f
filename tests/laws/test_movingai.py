"""Every problem of the MovingAI benchmarks, where the shared data is at hand: lengths equal the published ones."""

from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from support.fields import from_file

from planner_service.target_tree import TargetTree
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec
from swarm.wire.route_columns import RouteStatus

DATA = Path(__file__).parents[3] / "shared" / "data" / "movingai"
SCENARIOS = sorted(DATA.glob("*/*.scen"))
QUICK = 60


@pytest.mark.parametrize("most", [QUICK, pytest.param(None, marks=[pytest.mark.slow, pytest.mark.thorough])])
@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda path: path.name)
def test_problems_have_the_published_lengths(scenario: Path, most: int | None) -> None:
    """A sample of each file, or all."""
    pace = from_file(scenario.with_suffix(""))
    grid = GridSpec(pace.shape[0], pace.shape[1], 1.0)
    lines = [line.split() for line in scenario.read_text(encoding="utf-8").splitlines()[1:] if line]
    if most is not None:
        lines = lines[:: max(1, len(lines) // most)]
    by_goal: dict[int, list[list[str]]] = {}
    for line in lines:
        by_goal.setdefault(int(line[7]) * grid.cols + int(line[6]), []).append(line)
    tree = TargetTree(grid, PlannerConfig(strategy="full", cpu_budget=1.0))
    for goal, problems in by_goal.items():
        tree.update(pace, goal, [], 0)
        starts = [int(line[5]) * grid.cols + int(line[4]) for line in problems]
        for line, route in zip(problems, tree.routes(starts), strict=True):
            if float(line[8]) == 0 and line[4:6] != line[6:8]:  # published as a problem that has no solution
                assert route.status is RouteStatus.UNREACHABLE
                continue
            assert route.status is RouteStatus.OK
            digits = -int(Decimal(line[8]).as_tuple().exponent)
            # Half of the last digit, and what the publishers' own sums are off: the root of two of one file ends
            # after nine decimals, and others print 337.764 for 337.764502, as sums of its float32 value do.
            slack = 0.5 * 10.0**-digits + 5e-8 * route.length_m
            assert abs(route.length_m - float(line[8])) <= slack, (scenario.name, line)
            np.testing.assert_allclose(route.cost_s, route.length_m)
