"""Slope rules beside what their sources say; limits of steps, slopes across the way, and settings that stand for
others."""

import math
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.effort import few

from shared_map.terrain.pace_layers import terrain_pace
from shared_map.terrain.slope_and_climb import (
    ENTRIES,
    SLOPE_RULES,
    Climb,
    climb_of,
    directional_factor,
    slope_factor,
)
from shared_map.terrain.synthetic import mountain_noise
from shared_map.terrain.terrain import build_terrain
from swarm.config.contradictions import cost_faults
from swarm.config.ground import PRESETS, CostConfig
from swarm.config.scenario import Strategy
from swarm.config.scenario_files import load_scenario, parse_scenario
from swarm.errors import ConfigError
from swarm.grid import GridSpec
from swarm.wire.messages.map_data import PACE_LEAST, PACE_MOST

POINTS = ((-30.0, 3.0), (0.0, 1.0), (20.0, 4.0))
"""Points of the rule `table`."""


def ruled(rule: str, **given: object) -> CostConfig:
    table = {"slope_table": POINTS} if rule == "table" else {}
    return CostConfig(**{"slope_rule": rule, "max_slope_deg": 60.0, **table, **given})


def stepped(rule: str, *rises: float, **given: object) -> np.ndarray:
    return directional_factor(np.array(rises, np.float32), ruled(rule, **given)).astype(np.float64)


def at_deg(rule: str, *slopes_deg: float, **given: object) -> np.ndarray:
    return stepped(rule, *(math.tan(math.radians(each)) for each in slopes_deg), **given)


# --- what the sources say ---------------------------------------------------------------------------------------


def test_tobler_walks_5_04_km_h_on_the_level_and_6_down_5_percent() -> None:
    level_km_h = 6 * math.exp(-3.5 * 0.05)
    assert level_km_h == pytest.approx(5.04, abs=0.005)
    speeds = level_km_h / stepped("tobler", 0.0, -0.05, 0.2, -0.25)
    published = [6 * math.exp(-3.5 * abs(rise + 0.05)) for rise in (0.0, -0.05, 0.2, -0.25)]
    np.testing.assert_allclose(speeds, published, rtol=1e-5)
    assert speeds[1] == pytest.approx(6.0, rel=1e-5)


def test_naismith_takes_an_hour_for_600_m_and_langmuir_ten_minutes_for_300_m_down() -> None:
    def minutes(slope_deg: float, height_m: float) -> float:
        """Over as much of a slope as makes this height."""
        run_m = height_m / math.tan(math.radians(abs(slope_deg)))
        return run_m / 5000 * 60 * float(at_deg("naismith_langmuir", slope_deg)[0]), run_m / 5000 * 60

    for slope_deg, height_m, more in (
        (10, 600, 60),
        (-8, 300, -10),
        (-11.9, 300, -10),
        (-15, 300, 10),
        (-3, 300, 0),
    ):
        took, on_the_level = minutes(slope_deg, height_m)
        assert took - on_the_level == pytest.approx(more, abs=0.01), slope_deg


def test_a_wheeled_vehicle_is_slowed_by_its_motor_uphill_and_by_its_brakes_downhill() -> None:
    up, down, gentle, steep = at_deg("energy", 20, -20, -4, -35)
    sine, cosine = math.sin(math.radians(20)), math.cos(math.radians(20))
    assert up == pytest.approx(cosine + sine / 0.08, rel=1e-5)
    assert down == pytest.approx(sine / 0.08 - cosine, rel=1e-5)
    assert gentle == 1
    assert steep > 6  # it once cost as much as level ground
    reserve = at_deg("energy", 20, -20, power_reserve=2, braking_share=3)
    np.testing.assert_allclose(reserve, [up / 2, 1], rtol=1e-5)


def test_no_slope_makes_a_vehicle_quicker_than_its_top_speed() -> None:
    limited = stepped("tobler", -0.05, 0.02, flat_speed_m_per_s=1.5, top_speed_m_per_s=1.6)
    np.testing.assert_allclose(limited, [1.5 / 1.6, stepped("tobler", 0.02)[0]], rtol=1e-6)


def test_points_of_ones_own_are_joined_by_straight_lines_over_degrees() -> None:
    np.testing.assert_allclose(at_deg("table", -45, -30, -15, 0, 10, 20, 40), [3, 3, 2, 1, 2.5, 4, 4], rtol=1e-4)


# --- both ways --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rule", SLOPE_RULES)
def test_a_cell_costs_the_mean_of_up_and_down(rule: str) -> None:
    grades = np.linspace(0, 1.5, 400).astype(np.float32)
    cost = ruled(rule)
    up, down = directional_factor(grades, cost), directional_factor(-grades, cost)
    np.testing.assert_allclose(slope_factor(grades, cost), (up + down) / 2, rtol=1e-6)


def test_the_default_rule_is_the_same_bit_for_bit() -> None:
    grades = np.random.default_rng(1).gamma(1.5, 0.2, 5000).astype(np.float32)
    sine = grades / np.sqrt(grades * grades + np.float32(1))
    limit = math.sin(math.radians(35))
    plain = sine * sine * np.float32(5 / limit**2) + np.float32(1)
    plain[sine > np.float32(limit)] = np.inf
    np.testing.assert_array_equal(slope_factor(grades, CostConfig()), plain)


@given(
    rule=st.sampled_from(sorted(SLOPE_RULES)),
    flat=st.one_of(st.floats(0.01, 340), st.floats(0.01, 1.0), st.floats(100, 340)),
    grade=st.floats(0, 1e4, width=32),
    factor=st.sampled_from([1e-9, 1.0, 1e9]),
)
@settings(max_examples=few(60))
def test_no_pace_leaves_the_bounds_of_marks(rule: str, flat: float, grade: float, factor: float) -> None:
    cost = ruled(rule, max_slope_deg=90, flat_speed_m_per_s=flat, class_factor={"rock": factor})
    pace = terrain_pace(np.array([[grade, np.nan]], np.float32), np.array([[3, 3]], np.uint8), cost)
    assert np.float32(PACE_LEAST) <= pace[0, 0] <= np.float32(PACE_MOST)
    assert pace[0, 1] == np.inf


# --- limits of steps --------------------------------------------------------------------------------------------


def climb_on(elevation_m: np.ndarray, cost: CostConfig) -> Climb:
    climb = climb_of(GridSpec(*elevation_m.shape, 10.0), elevation_m.astype(np.float32), cost)
    assert climb is not None
    return climb


@pytest.mark.parametrize("rule", SLOPE_RULES)
@pytest.mark.parametrize(("climb_deg", "descent_deg"), [(35, 35), (20, 30), (30, 12), (5, None)])
def test_no_step_is_steeper_than_its_limit(rule: str, climb_deg: float, descent_deg: float | None) -> None:
    cost = ruled(rule, directional=True, max_slope_deg=40.0, max_climb_deg=climb_deg, max_descent_deg=descent_deg)
    slopes_deg = np.arange(-60, 61, 3) + 0.5
    heights = np.zeros((1, 2), np.float32)
    for slope in slopes_deg:
        heights[0, 1] = 10.0 * math.tan(math.radians(slope))
        climb = climb_on(heights, cost)
        allowed = -(descent_deg or 40.0) <= slope <= climb_deg
        assert climb.allows(0, 1) == allowed, slope
        assert climb.driven(0, 1) <= climb.highest < math.inf
        assert (climb.along(np.array([0]), np.array([1]))[0] < np.inf) == allowed
    assert climb.factors[ENTRIES] == 1


def test_a_step_of_just_the_limit_is_allowed_and_a_hair_more_is_not() -> None:
    for steepest_deg in (5.0, 20.0, 45.0, 60.0):
        cost = CostConfig(directional=True, max_slope_deg=steepest_deg)
        rise_m = 10.0 * math.tan(math.radians(steepest_deg))
        for share, allowed in ((1.0, True), (1.0005, False)):
            climb = climb_on(np.array([[0.0, rise_m * share]]), cost)
            assert climb.allows(0, 1) == climb.allows(1, 0) == allowed
    assert "none is steeper than 60 degrees up or 60 degrees down" in climb.note


def test_a_step_beside_a_void_is_level() -> None:
    heights = np.tile(np.arange(12.0), (3, 1))
    heights[1, 5] = np.nan
    climb = climb_on(heights, ruled("energy", directional=True))
    assert climb.of_step(16, 17) == climb.of_step(17, 18) == 1.0
    np.testing.assert_array_equal(climb.along(np.array([16, 17]), np.array([17, 18])), 1.0)


def test_one_step_and_many_steps_read_the_same_table() -> None:
    heights = mountain_noise(np.random.default_rng(4), 30, 40, 10.0).whole() * 60
    climb = climb_on(heights, ruled("tobler", directional=True))
    pairs = [(cell, other) for cell in range(0, 1200, 7) for _, other in climb.grid.neighbours(cell)]
    tails, heads = np.array(pairs).T
    alone = np.array([climb.of_step(tail, head) for tail, head in pairs])
    np.testing.assert_array_equal(climb.along(tails, heads), alone.astype(np.float32))


def test_the_paces_of_a_directional_terrain_are_those_of_level_ground() -> None:
    text = '[terrain]\nsource = "synthetic"\nrows = 48\ncols = 64\n[cost]\ndirectional = true\nclasses = false\n'
    terrain = build_terrain(parse_scenario(text))
    np.testing.assert_allclose(terrain.pace_s_per_m[~terrain.lethal], 0.1)
    assert any("level ground" in note for note in terrain.notes)
    assert build_terrain(parse_scenario(f'{text}slope_rule = "tobler"')).digest != terrain.digest


def test_every_strategy_goes_with_direction_and_a_price_of_length_does_not() -> None:
    for strategy in get_args(Strategy):
        parse_scenario(f'[cost]\ndirectional = true\n[planner]\nstrategy = "{strategy}"')
    with pytest.raises(ConfigError, match="leave it out"):
        parse_scenario("[cost]\ndirectional = true\n[planner]\nlength_weight = 0.1")


def test_a_terrain_says_its_rule_and_its_preset() -> None:
    def notes(more: str) -> tuple[str, ...]:
        text = f'[terrain]\nsource = "synthetic"\nrows = 40\ncols = 40\n[cost]\n{more}'
        return build_terrain(parse_scenario(text)).notes

    level = "no preset: 10 m/s (36 km/h) on level open ground"
    assert f"{level}, slope rule quadratic, each step by its way up or down" in notes("directional = true")
    hiker = "preset hiker: 0.84 m/s (3.02 km/h) on level open ground, slope rule tobler, the mean of up and down"
    assert any(note.startswith(hiker) for note in notes('preset = "hiker"'))


# --- presets ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_is_a_scenario_that_fits_together(name: Any) -> None:
    cost = CostConfig(preset=name)
    assert list(cost_faults(cost, "cost")) == []
    assert {key: getattr(cost, key) for key in PRESETS[name]} == PRESETS[name]
    assert np.isfinite(slope_factor(np.linspace(0, 0.5, 20).astype(np.float32), cost)).all()


def test_settings_of_a_scenario_win_over_those_of_its_preset_key_by_key() -> None:
    cost = parse_scenario(
        '[cost]\npreset = "tracked"\nmax_slope_deg = 35\nflat_speed_m_per_s = 10\nclass_factor = { rock = 4 }'
    ).cost
    assert (cost.slope_rule, cost.max_slope_deg, cost.flat_speed_m_per_s) == ("energy", 35.0, 10.0)
    assert cost.class_factor == {"forest": 1.5, "rock": 4.0, "soil": 1.0, "snow": 1.5}


@given(
    preset=st.sampled_from([None, *PRESETS]),
    own=st.fixed_dictionaries(
        {},
        optional={
            "slope_rule": st.sampled_from(["linear", "quadratic", "energy", "tobler"]),
            "flat_speed_m_per_s": st.floats(0.5, 10),
            "steep_factor": st.floats(1, 9),
            "max_slope_deg": st.floats(10, 60),
            "class_factor": st.dictionaries(st.sampled_from(["forest", "rock", "snow"]), st.floats(0.5, 9)),
        },
    ),
)
@settings(max_examples=few(60))
def test_a_preset_and_own_settings_mean_the_same_in_python_and_in_a_file(
    preset: str | None, own: dict[str, Any]
) -> None:
    given = own if preset is None else {"preset": preset, **own}
    assert CostConfig(**given) == parse_scenario("", settings={"cost": given}).cost


# --- tables in files --------------------------------------------------------------------------------------------


def scenario_with(folder: Path, table: str, more: str = "") -> CostConfig:
    (folder / "slopes.csv").write_text(table, encoding="utf-8")
    (folder / "mine.toml").write_text(f'[cost]\nslope_rule = "table"\nslope_csv = "slopes.csv"\n{more}')
    return load_scenario(folder / "mine.toml").cost


def test_a_table_in_a_file_is_of_factors_paces_or_speeds_by_degrees_or_percent(tmp_path: Path) -> None:
    by_factor = scenario_with(tmp_path, "slope_deg,factor\n-45,2\n0,1\n45,3\n")
    assert by_factor.slope_table == ((-45.0, 2.0), (0.0, 1.0), (45.0, 3.0))
    assert by_factor.slope_csv is None
    by_speed = scenario_with(tmp_path, "slope_percent, speed_m_per_s\n-100, 5\n\n0, 10\n100, 3.3333333333\n")
    by_pace = scenario_with(tmp_path, "\ufeffslope_percent,pace_s_per_m\n-100,0.2\n0,0.1\n100,0.3\n")
    for other in (by_speed, by_pace):
        np.testing.assert_allclose(other.slope_table, by_factor.slope_table, rtol=1e-9)


def test_a_file_that_is_no_table_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="is no table of comma-separated values"):
        scenario_with(tmp_path, 'slope_deg,factor\n"' + "0" * 200_000)
