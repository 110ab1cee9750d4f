"""A wrong scenario is refused with the file, the key, the found value, the allowed values and the nearest name."""

from __future__ import annotations

import re
from pathlib import Path
from typing import get_args, get_type_hints

import pytest

from swarm.config.agents import plan_agents
from swarm.config.explain import meanings
from swarm.config.load import load_scenario, parse_scenario
from swarm.config.scenario import Scenario
from swarm.config.setting_types import Section
from swarm.errors import ConfigError


def refusal(text: str) -> str:
    with pytest.raises(ConfigError) as caught:
        parse_scenario(text, "demo.toml")
    assert caught.value.exit_code == 2
    return str(caught.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("sed = 3", ["unknown key sed", "did you mean 'seed'?", "allowed here: name, seed, seconds"]),
        ("[terain]\nroads = 3", ["unknown key terain", "'terrain'"]),
        ("[terrain]\nrodes = 3", ["unknown key terrain.rodes", "'roads'"]),
        ("[terrain.hidden]\nrubble = 3", ["unknown key terrain.hidden.rubble", "'rubble_fields'"]),
        ("[[targets]]\nname = 'a'\nspeed = 4", ["unknown key targets[0].speed", "'speed_m_per_s'"]),
        ("[[targets]]\n[[targets]]\ncuont = 4", ["unknown key targets[1].cuont", "'count'"]),
        ("[network]\nqwertyuiop = 1", ["unknown key network.qwertyuiop", "allowed here: namespace, listen"]),
        ("[network.tls]\nca = 'x'\ncertificate = 'y'\nkey = 'z'\nkeys = 1", ["network.tls.keys", "'key'"]),
        ("seed = 'three'", ["seed: found 'three', expected a whole number, at least 0"]),
        ("seed = -1", ["seed: found -1, expected a whole number, at least 0"]),
        ("seconds = 0", ["seconds: found 0, expected a number, more than 0"]),
        ("seconds = nan", ["seconds", "found nan"]),
        ("seconds = inf", ["seconds", "found inf"]),
        ("name = 'a b'", ["name", "found 'a b'"]),
        (
            "[planner]\nstrategy = 'fast'",
            ["planner.strategy", "found 'fast'", "allowed: 'auto', 'exact', 'full'"],
        ),
        ("[planner]\nstrategy = 'rotation'", ["planner.strategy: found 'rotation'", "allowed: 'auto', 'exact'"]),
        ("[planner]\nfull_every = 10", ["unknown key planner.full_every", "strategy"]),
        ("[planner]\nneighbours = 6", ["planner.neighbours", "found 6", "allowed: '4', '8'"]),
        ("[planner]\ncpu_budget = 1.5", ["planner.cpu_budget", "found 1.5", "more than 0, up to 1"]),
        ("[[targets]]\nwalk = 'run'", ["targets[0].walk", "found 'run'", "allowed: 'still', 'random'"]),
        ("[[targets]]\nstart = [1]", ["targets[0].start", "expected [a whole number, a whole number]"]),
        ("[[targets]]\nstart = [1, 'x']", ["targets[0].start[1]", "found 'x'"]),
        ("targets = []", ["targets: found [], expected a list, not empty"]),
        ("[[cost.zones]]\nkind = 'lava'\npolygon_m = [[0,0],[1,0],[1,1]]", ["cost.zones[0].kind", "'forbidden'"]),
        (
            "[[cost.zones]]\nkind = 'road'\npolygon_m = [[0,0],[1,0]]",
            ["cost.zones[0].polygon_m", "a list, of at least 3"],
        ),
        ("[[cost.zones]]\nkind = 'road'\npolygon_m = [[0,0],[1,0],[nan,1]]", ["polygon_m[2][0]", "found nan"]),
        ("[[cost.zones]]\nkind = 'road'", ["cost.zones[0]", "missing required field `polygon`"]),
        ("[[groups]]\nvehicles = 0", ["groups[0].vehicles", "found 0", "1 to 100000"]),
        ("[[groups]]\nvehicles = 2.5", ["groups[0].vehicles", "found 2.5, expected a whole number"]),
        ("[monitor]\nshow_target = 'u'", ["monitor.show_target is 'u', which is no target"]),
        ("[[groups]]\ntargets = ['u']\n[[targets]]\nname = 't'", ["groups: all chases 'u', which is no target"]),
        ("[[groups]]\ntargets = ['t']\n[[targets]]\ncount = 2", ["all chases 't'", "did you mean 't"]),
        ("[[groups]]\n[[groups]]", ["two groups are called 'all'"]),
        ("[[targets]]\nname = 'x'\n[[targets]]\nname = 'x'", ["two targets are called 'x'"]),
        ("[[targets]]\nname = 'x'\ncount = 2\n[[targets]]\nname = 'x1'", ["two targets are called 'x1'"]),
        ("[[targets]]\nname = 'x.r1'", ["'x.r1' is what a standby of another target is called"]),
        ("[standbys]\nplanner = 10", ["standbys.planner", "found 10", "0 to 9"]),
        ("[standbys]\nagents = 1", ["unknown key standbys.agents", "allowed here: planner, targets"]),
        ("[network]\nlisten = ['udp/1.2.3.4:7']", ["network.listen", "'udp/1.2.3.4:7' is not an endpoint"]),
        ("[network]\nlisten = ['tcp/127.0.0.1:99999']", ["network.listen", "is not an endpoint"]),
        ("[network]\nconnect = ['tcp/10.0.0.1:7447']", ["network.connect", "in the clear", "tls/10.0.0.1:7447"]),
        ("[network]\npeers = ['tcp/10.0.0.1:7447']", ["network.peers", "in the clear"]),
        ("[network]\nconnect = ['tls/host:7447']", ["needs network.tls with ca, certificate and key"]),
        ("[network]\nlease_s = 0.1", ["network.lease_s", "found 0.1", "0.5 to 60"]),
        ("[monitor]\nweb_port = 70000", ["monitor.web_port", "found 70000", "0 to 65535"]),
        ("seed = ", ["demo.toml: not TOML: line 1", "no value that TOML knows", "found 'seed ='"]),
        ("seed = 1\nseed = 2", ["not TOML: line 2", "set twice", "found 'seed = 2'"]),
        ("seed = True", ["line 1, column 8: no value that TOML knows", "true and false in small letters"]),
        ('name = "a', ["line 1", "a quote is missing at the end, found 'name = \"a'"]),
        ('name = "a\nseed = 1', ["line 1, column 10: a quote is missing at the end"]),
        ("[map]\n[map]", ["line 2", "a section occurs twice", "found '[map]'"]),
        ("seconds = 5 m", ["line 1, column 13: nothing may follow a value; units are in the keys' names"]),
        ("[network]\nlisten = ['a'\n\n", ["line 2: a bracket that is opened is not closed"]),
        ("seed 1", ["line 1, column 6: expected KEY = VALUE or [SECTION], found 'seed 1'"]),
        (f"seed = 1{'0' * 5000}", ["not TOML: it holds a number of thousands of digits"]),
        (f"seed = {'x' * 5000}", ["found 'seed = xxx", "xxx...'"]),
        ("terrain = 3", ["terrain", "found 3, expected a table: [terrain]"]),
    ],
)
def test_a_wrong_scenario_is_explained(text, words):
    reason = refusal(text)
    assert reason.startswith("demo.toml: ")
    assert "\n" not in reason
    for word in words:
        assert word in reason, reason


def test_a_file_that_cannot_be_read_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"cannot read scenario .*none.toml: No such file"):
        load_scenario(tmp_path / "none.toml")
    with pytest.raises(ConfigError, match="cannot read"):
        load_scenario(tmp_path)
    (tmp_path / "binary.toml").write_bytes(b"seed = \xff")
    with pytest.raises(ConfigError, match=r"binary.toml is not text in UTF-8: .* at byte 7"):
        load_scenario(tmp_path / "binary.toml")


def test_an_empty_scenario_is_a_whole_one():
    scenario = parse_scenario("")
    assert scenario == Scenario()
    assert scenario.target_ids == ["t"]
    assert scenario.vehicle_count == 100


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


def test_agents_take_so_many_vehicles_each_and_one_group():
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


def test_a_scenario_comes_through_a_file_unchanged():
    scenario = parse_scenario("[[targets]]\nname = 'x'\ncount = 2\nstart = [3, 4]\nspeed_m_per_s = 2")
    assert scenario.targets[0].start == (3, 4)
    assert scenario.targets[0].speed_m_per_s == 2.0
    assert scenario.target_ids == ["x0", "x1"]


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
