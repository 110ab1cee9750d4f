"""Arguments of calls from Python that cannot be meant: each is refused in one family, by its name."""

from collections.abc import Callable
from decimal import Decimal
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from support.client_rig import Program
from support.planner_swarm import GRID as CLIENT_GRID
from support.planner_swarm import Swarm, rough

from planner_service import RouteFinder
from shared_map.terrain.terrain import build_terrain
from swarm.client import Frame
from swarm.config.ground import CostConfig, TerrainConfig
from swarm.config.scenario import Scenario
from swarm.errors import ArgumentError, ConfigError, SwarmError
from swarm.grid import GridSpec

GRID = GridSpec(12, 14, 1.0)
NUMBERS = [np.dtype(kind).type(3) for kind in "bBhHiIqQefdg"]
ODD = [
    None, True, "x y", "", b"1", "7" * 5000, [], [[1, 2], [3]], {"a": 1}, object(), lambda: 0, 1j, np.nan, np.inf,
    -np.inf, 10**30, -(10**30), 1e300, np.bool_(True), np.complex64(1), np.datetime64("2020-01-01"), np.str_("x y"),
    np.timedelta64(1, "s"), np.zeros(0), np.ones((2, 2, 2)), np.array(["a"]), np.array([None]), Decimal("nan"),
]  # fmt: skip
"""Values that mean no place, no cell, no number and no name."""


def finder() -> RouteFinder:
    return RouteFinder(np.ones(GRID.shape), (3, 3))


CALLS: dict[str, Callable[[Any], Any]] = {
    "target": lambda odd: finder().move(odd),
    "row": lambda odd: finder().route(odd, 1),
    "col": lambda odd: finder().route(1, odd),
    "start": lambda odd: finder().between(odd, (1, 1)),
    "goal": lambda odd: finder().between((1, 1), odd),
    "row of change": lambda odd: finder().change([[1.0]], odd),
    "route": lambda odd: finder().pull(odd),
    "scenario": build_terrain,
    "cell": GRID.row_col,
    "y_m": lambda odd: GRID.cell_at(1.0, odd),
    "cols": lambda odd: GridSpec(3, odd, 1.0),
}


@pytest.mark.parametrize("name", CALLS)
@pytest.mark.parametrize("odd", ODD, ids=range(len(ODD)))
def test_what_cannot_be_meant_is_refused_without_a_network(name: str, odd: Any) -> None:
    if isinstance(odd, int | float) and name == "y_m" and 1e20 < abs(odd) < np.inf:
        assert CALLS[name](odd) == -1, "far away is a place, and outside"
        return
    with pytest.raises(ArgumentError) as caught:
        CALLS[name](odd)
    assert isinstance(caught.value, SwarmError)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("odd", ODD, ids=range(len(ODD)))
def test_what_cannot_be_meant_is_refused_by_a_client(odd: Any) -> None:
    program = Program(Swarm(rough(3, lethal=0.0))).swarm
    frame, rover, orders = program.frame, program.vehicle("rover"), program.orders()
    x_m, y_m = frame.centre_m(CLIENT_GRID.cell(5, 5))
    rover.at(x_m, y_m)
    rover.give_way(Mock(stands=lambda cell: True, counted=lambda cell, x_m, y_m: cell))
    calls: dict[str, Callable[[], Any]] = {
        "id": lambda: program.vehicle(odd),
        "id of target": lambda: program.target(odd),
        "group": lambda: program.vehicle("other", group=odd),
        "radius_m": lambda: program.vehicle("other", radius_m=odd),
        "lease_s": lambda: program.vehicle("other", lease_s=odd),
        "lease_s of target": lambda: program.target("other", lease_s=odd),
        "vehicle_class": lambda: program.route_soon("t", x_m, y_m, vehicle_class=odd),
        "timeout_s": lambda: program.route_soon("t", x_m, y_m, timeout_s=odd),
        "timeout_s of route": lambda: program.route((x_m, y_m), (x_m, y_m), timeout_s=odd),
        "timeout_s of rover": lambda: rover.route_soon("t", odd),
        "every_s": lambda: program.observer(every_s=odd),
        "x_m": lambda: rover.at(odd, y_m),
        "y_m": lambda: rover.at(x_m, odd),
        "x_m of cell": lambda: frame.cell(odd, y_m),
        "speed_m_per_s": lambda: rover.at(x_m, y_m, speed_m_per_s=odd),
        "cell": lambda: rover.mark([odd], lethal=True),
        "cell of frame": lambda: frame.centre_m(odd),
        "cell to write": lambda: frame.written(odd),
        "cell to enter": lambda: rover.may_enter(odd),
        "cell to reserve": lambda: rover.reserve([odd]),
        "places": lambda: orders.send("v0", odd),
        "lethal": lambda: rover.mark([5], lethal=odd, clear=odd),
        "pace_s_per_m": lambda: rover.mark([5], pace_s_per_m=odd),
        "target": lambda: rover.follow(odd),
        "start_m": lambda: program.route(odd, (x_m, y_m), timeout_s=0.0),
        "polygon_m": lambda: orders.add_zone(odd),
        "lat_deg": lambda: Frame(GridSpec(3, 3, 1.0, crs="EPSG:4326")).from_wgs84(odd, 1.0),
    }
    for name, call in calls.items():
        with pytest.raises(ConfigError) as caught:
            call()
        assert "\n" not in str(caught.value)
        named = name.split("_")[0].split()[0]
        elsewhere = name in ("target", "pace_s_per_m")
        assert named in str(caught.value) or elsewhere, (name, str(caught.value))


def test_a_list_is_no_text_and_no_number_and_a_number_is_no_text() -> None:
    program = Program(Swarm(rough(3, lethal=0.0))).swarm
    rover = program.vehicle("rover")
    for cells in (5, "55", b"55", np.int64(5), np.array(5)):
        with pytest.raises(ConfigError, match=r"cells is .*, expected a list"):
            rover.mark(cells, lethal=True)  # type: ignore[arg-type]
    wrong_targets: list[Any] = ["t0", object(), 1j, len, np.ones((2, 2)), [object()], {"t0": 1}]
    for targets in wrong_targets:
        with pytest.raises(ConfigError, match=r"the order is not possible: targets.* expected"):
            program.orders().chase("all", targets)
    for wrong in (True, "7", None, np.nan):
        with pytest.raises(ConfigError, match="radius_m is"):
            program.frame.cells_within(5.0, -5.0, wrong)  # type: ignore[arg-type]
        with pytest.raises(ConfigError, match="the place is"):
            program.frame.cell_named((wrong, 3))  # type: ignore[arg-type]


@pytest.mark.parametrize("number", NUMBERS, ids=lambda number: number.dtype.char)
def test_numbers_of_numpy_are_numbers(number: Any, tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", elevation=np.add.outer(np.arange(20.0) ** 2, np.arange(20.0)), resolution_m=10.0)
    terrain = TerrainConfig(source=str(tmp_path / "a.npz"), water_below_m=number)
    assert build_terrain(Scenario(terrain=terrain)).grid.rows == 20
    assert RouteFinder(np.ones((3, 3)), (0, 0), resolution_m=number).route(0, 1).cost_s == 3
    assert Frame(GRID).cell_named((number, 1)) == GRID.cell(3, 1)
    assert Frame(GRID).centre_m(GRID.cell(3, 1)) == GRID.centre_m(GRID.cell(3, 1))


def test_a_wrong_keyword_is_told_the_nearest() -> None:
    wrong: list[tuple[Any, dict[str, Any], str]] = [
        (TerrainConfig, {"sorce": "a.tif"}, "TerrainConfig: unknown key sorce; did you mean 'source'?"),
        (CostConfig, {"presets": "hiker"}, "CostConfig: unknown key presets; did you mean 'preset'?"),
        (Scenario, {"terrian": TerrainConfig()}, "Scenario: unknown key terrian; did you mean 'terrain'?"),
        (
            RouteFinder,
            {"pace": np.ones((3, 3)), "trget": 0},
            "RouteFinder: unknown key trget; did you mean 'target'?",
        ),
    ]
    for call, keywords, words in wrong:
        with pytest.raises(ConfigError) as caught:
            call(**keywords)
        assert str(caught.value) == words
    with pytest.raises(ConfigError, match="no preset 'hikers'; did you mean 'hiker'"):
        CostConfig(preset="hikers")
