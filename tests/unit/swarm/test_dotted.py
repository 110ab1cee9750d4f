"""Settings by dotted keys: their changes, and the answer to a key that leads nowhere."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm.config.scenario_files import flat, parse_scenario, with_settings
from swarm.errors import ConfigError

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
