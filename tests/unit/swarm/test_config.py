"""A wrong scenario is refused with the file, the key, the found value, the allowed values and the nearest name."""

import re
from pathlib import Path
from typing import get_args, get_type_hints

import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm.config.explain import meanings
from swarm.config.scenario import Scenario, crew_of, ids_of, plan_agents
from swarm.config.scenario_files import (
    flat,
    load_scenario,
    parse_scenario,
    read_scenario,
    scenario_text,
    with_settings,
)
from swarm.config.setting_types import Section
from swarm.config.vehicle_classes import of_class
from swarm.errors import ConfigError


def refusal(text: str) -> str:
    with pytest.raises(ConfigError) as caught:
        parse_scenario(text, "demo.toml")
    assert caught.value.exit_code == 2
    return str(caught.value)


def test_a_file_that_cannot_be_read_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"cannot read scenario .*none.toml: No such file"):
        load_scenario(tmp_path / "none.toml")
    with pytest.raises(ConfigError, match="cannot read"):
        load_scenario(tmp_path)
    (tmp_path / "binary.toml").write_bytes(b"seed = \xff")
    with pytest.raises(ConfigError, match=r"binary.toml is not text in UTF-8: .* at byte 7"):
        load_scenario(tmp_path / "binary.toml")


def test_a_scenario_of_one_endless_line_is_refused_in_a_short_sentence():
    assert "demo.toml: not TOML: it holds a number of thousands of digits" in refusal(f"seed = 1{'0' * 5000}")
    assert re.search(r"found 'seed = xxx+\.\.\.'", refusal(f"seed = {'x' * 5000}"))


def test_an_empty_scenario_is_a_whole_one():
    scenario = parse_scenario("")
    assert scenario == Scenario()
    assert scenario.target_ids == ["t"]
    assert scenario.vehicle_count == 100
    (several,) = parse_scenario("[[targets]]\nname = 'x'\ncount = 2\nstart = [3, 4]\nspeed_m_per_s = 2").targets
    assert (several.start, several.speed_m_per_s, ids_of(several)) == ((3, 4), 2.0, ["x0", "x1"])


def test_a_run_needs_each_keeper_whose_name_its_routers_admit():
    assert ("keeper", "0") in crew_of(Scenario())
    crew = crew_of(parse_scenario("[network]\nadmit = ['keeper.east', 'keeper.0', 'operator.anna']"))
    assert [id for role, id in crew if role == "keeper"] == ["0", "east"]


def test_a_scenario_which_version_0_2_wrote_is_read_under_the_names_of_today(caplog):
    """It has all keys of 0.2 which are no more, also in the costs of classes, with values of its presets."""
    old = (Path(__file__).parents[2] / "specimens/scenario-0.2.0.toml").read_text("utf-8")
    new, gone = re.subn(r"(?m)^(grpc_port|critical_slope\w*|cross_slope\w*|rough_per_m) = .*\n", "", old)
    new = new.replace("plot_regions", "shard_regions").replace("body_radius_m", "obstacle_radius_m")
    assert (parse_scenario(old), gone) == (parse_scenario(new), 13)
    assert {record.message.partition(": ")[0] for record in caplog.records} == {
        "map.plot_regions is shard_regions now", "targets.body_radius_m is obstacle_radius_m now",
    }  # fmt: skip
    for preset, factor in (("hiker", 1.0), ("wheeled", 2.0), ("tracked", 1.5)):
        text = f"[cost]\npreset = '{preset}'\n"
        assert parse_scenario(f"{text}cross_slope_factor = {factor}") == parse_scenario(text)


def test_a_fault_of_cost_is_said_once_however_many_classes_have_it_from_there():
    for fault in ("frction = 1", "flat_speed_m_per_s = -1", "max_climb_deg = 9"):
        text = f"[cost]\n{fault}\n[[classes]]\nname = 'a'\n[[classes]]\nname = 'b'\ncost.vehicle_radius_m = 2"
        assert len(read_scenario(text, "s").faults) == 1


@pytest.mark.parametrize(
    ("setting", "meant"),
    [
        ('[vehicles]\nsense_range_m = "60 m"', "sense_range_m = 60"),
        ('[vehicles]\nsense_range_m = "1,5 km"', "sense_range_m = 1500"),
        ('seconds = "90 s"', "seconds = 90"),
        ('seconds = "2 min"', "seconds = 120"),
        ('[[targets]]\nspeed_m_per_s = "36 km/h"', "speed_m_per_s = 10"),
        ('[[targets]]\nspeed_m_per_s = "3 m/s"', "speed_m_per_s = 3"),
    ],
)
def test_a_number_with_its_unit_is_answered_in_the_unit_of_the_key(setting: str, meant: str) -> None:
    with pytest.raises(ConfigError, match=rf"leave out the unit: {meant}$"):
        parse_scenario(setting)


def test_relative_files_lie_beside_the_scenario(tmp_path):
    path = tmp_path / "demo.toml"
    path.write_text("[terrain]\nsource = 'hills.tif'\nphoto = 'hills-photo.tif'")
    terrain = load_scenario(path).terrain
    assert terrain.source == str(tmp_path / "hills.tif")
    assert terrain.photo == str(tmp_path / "hills-photo.tif")
    path.write_text("[terrain]\nsource = 'synthetic'")
    assert load_scenario(path).terrain.source == "synthetic"


def test_loopback_needs_no_certificates_and_elsewhere_does():
    tls = "tls = {ca = 'ca.pem', certificate = 'c.pem', key = 'k.pem'}"
    for endpoint in ("tcp/127.0.0.1:7447", "tcp/localhost:1", "tcp/[::1]:7447"):
        assert parse_scenario(f"[network]\nlisten = ['{endpoint}']").network.listen == (endpoint,)
    assert parse_scenario(f"[network]\nlisten = ['tls/0.0.0.0:7447']\n{tls}").network.tls is not None
    assert "in the clear" in refusal(f"[network]\nlisten = ['tcp/0.0.0.0:7447']\n{tls}")
    assert "quic/ is not offered, as strangers" in refusal(f"[network]\nlisten = ['quic/0.0.0.0:7447']\n{tls}")


def test_agents_take_the_stated_number_of_vehicles_each_and_one_group():
    scenario = parse_scenario(
        "[vehicles]\nper_agent = 4\n[[groups]]\nname = 'a'\nvehicles = 6\n[[groups]]\nname = 'b'\nvehicles = 4"
    )
    agents = plan_agents(scenario)
    assert [(agent.id, agent.group.name, agent.first, agent.count) for agent in agents] == [
        ("a0", "a", 0, 4),
        ("a1", "a", 4, 2),
        ("a2", "b", 0, 4),
    ]
    ids = [id for agent in agents for id in agent.vehicle_ids]
    assert len(set(ids)) == scenario.vehicle_count
    assert ids[4] == "a1-00"


def sections_of(kind: type) -> set[type[Section]]:
    """A section and all sections that its fields reach; other modules have sections of files of their own."""
    found: set[type[Section]] = set()
    waiting = [kind]
    while waiting:
        kind = waiting.pop()
        if isinstance(kind, type) and issubclass(kind, Section):
            if kind not in found:
                found.add(kind)
                waiting += get_type_hints(kind).values()
        else:
            waiting += get_args(kind)
    return found


@pytest.mark.parametrize("section", sorted(sections_of(Scenario), key=str), ids=lambda section: section.__name__)
def test_every_setting_has_its_row_and_every_row_its_setting(section):
    assert list(meanings(section)) == list(section.__struct_encode_fields__)
    assert all(meaning.strip() for meaning in meanings(section).values())


def test_a_row_goes_on_in_the_lines_below_it_and_ends_before_the_next_sentence():
    class Tank(Section, frozen=True):
        """A tank.

        size_l  how much it holds,
                in litres
        full    whether it is

        A sentence with  two blanks.
        """

        size_l: float = 1.0
        full: bool = False

    assert meanings(Tank) == {"size_l": "how much it holds, in litres", "full": "whether it is"}


def test_no_pattern_of_a_setting_lets_a_line_end_through() -> None:
    """`$` matches before the last line end, too: `\\Z` does not."""
    packages = ("swarm", "shared_map", "planner_service", "vehicle_agent", "launch_scripts")
    sources = [path for each in packages for path in (Path(__file__).parents[3] / each).rglob("*.py")]
    ends = re.compile(r"""pattern=r?["'][^\n]*\$["']""")
    found = [str(path) for path in sources if ends.search(path.read_text("utf-8"))]
    assert (found, len(sources) > 300) == ([], True)


# --- classes of vehicles: what each inherits, and the sentence for each fault ------------------------------

_TWO = """
cost = { slope_rule = "table", slope_table = [[-30, 2.0], [0, 1.0], [30, 4.0]], max_slope_deg = 25.0 }
[[classes]]
name = "walker"
max_speed_m_per_s = 0.5
cost = { preset = "hiker", class_factor = { rock = 1.25 } }
[[classes]]
name = "same"
"""


def test_a_class_is_what_it_says_over_its_preset_over_the_common_cost_or_the_scenario_itself() -> None:
    scenario = parse_scenario(_TWO)
    walker = of_class(scenario, "walker")
    assert (walker.cost.slope_rule, walker.cost.max_slope_deg, walker.cost.slope_table) == ("tobler", 40.0, ())
    speeds = walker.cost.flat_speed_m_per_s, walker.cost.road_speed_m_per_s, walker.cost.top_speed_m_per_s
    assert speeds == (0.5, 0.5, 0.5)
    assert walker.cost.class_factor == {"rock": 1.25}
    assert of_class(scenario, "ground") is scenario
    assert of_class(scenario, "same") == scenario
    assert parse_scenario("").classes == ()
    with pytest.raises(ConfigError, match=r"has no class 'boat'.*ground"):
        of_class(Scenario(), "boat")


def test_a_written_scenario_has_the_same_classes(tmp_path: Path) -> None:
    (tmp_path / "scenario.toml").write_text(_TWO)
    scenario = load_scenario(tmp_path / "scenario.toml")
    (tmp_path / "again.toml").write_text(scenario_text(scenario, tmp_path))
    assert load_scenario(tmp_path / "again.toml") == scenario


# --- settings by dotted keys: their changes, and the answer to a key that leads nowhere --------------------

_TABLES = st.recursive(
    st.integers() | st.text(max_size=3) | st.lists(st.integers(), max_size=2),
    lambda inner: st.dictionaries(st.text("abc", min_size=1, max_size=2), inner, min_size=1, max_size=3),
    max_leaves=8,
)


@given(st.dictionaries(st.text("abc", min_size=1, max_size=2), _TABLES, max_size=3))
def test_what_is_set_key_by_key_into_nothing_is_the_table_itself(table):
    assert with_settings({}, dict(flat(table)), "x") == table


def test_a_setting_takes_the_place_of_what_the_file_says_and_the_file_stays_as_it_was():
    raw = {"groups": [{"vehicles": 2}, {"vehicles": 3}], "map": {"learning": True}}
    changed = with_settings(raw, {"groups.*.vehicles": 7, "groups.1.name": "b", "map.digest_s": 2.0}, "x")
    assert changed == {
        "groups": [{"vehicles": 7}, {"vehicles": 7, "name": "b"}],
        "map": {"learning": True, "digest_s": 2.0},
    }
    assert raw == {"groups": [{"vehicles": 2}, {"vehicles": 3}], "map": {"learning": True}}


@pytest.mark.parametrize(
    ("key", "said"),
    [
        ("groups.2.vehicles", "x: groups.2.vehicles: found '2' in a list, expected a number from 0 to 0 or '*'"),
        ("groups.vehicles", "found 'vehicles' in a list"),
        ("groups.-1.vehicles", "found '-1' in a list"),
        ("name.first", "x: name.first: found 'n' above 'first', expected a table"),
        ("empty.0", "expected nothing, as it is empty, or '*'"),
        (".".join("a" * 17), "a key has more than 16 parts"),
        (".".join("a" * 5000), "a key has more than 16 parts"),
    ],
)
def test_a_key_that_leads_nowhere_is_refused_with_what_was_found(key, said):
    with pytest.raises(ConfigError) as error:
        with_settings({"groups": [{"vehicles": 1}], "name": "n", "empty": []}, {key: 1}, "x")
    assert said in str(error.value)


def test_a_preset_as_a_setting_brings_its_own_settings():
    text = '[cost]\npreset = "hiker"'
    wheeled = parse_scenario(text, settings={"cost.preset": "wheeled"})
    assert wheeled.cost == parse_scenario('[cost]\npreset = "wheeled"').cost
