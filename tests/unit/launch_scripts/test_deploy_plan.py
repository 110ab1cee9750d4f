"""`swarm deploy plan`: what a file of machines may say, and how an impossible demand is answered."""

from __future__ import annotations

import pytest

from launch_scripts.deploy.hosts import parse_hosts
from launch_scripts.deploy.machine_plan import make_plan
from swarm.config.scenario import Scenario, StandbyConfig
from swarm.errors import ConfigError

THREE = "".join(f'[[hosts]]\nname = "m{n}"\naddress = "10.0.0.{n}"\n' for n in (1, 2, 3))


@pytest.mark.parametrize(
    ("text", "answer"),
    [
        ("", "missing required field `hosts`"),
        ("hosts = []", "hosts"),
        ('[[hosts]]\nname = "A b"\naddress = "a"', "hosts[0].name"),
        ('[[hosts]]\nname = "a"', "missing required field `address`"),
        ('[[hosts]]\nname = "a"\naddress = "a"\nroles = ["planer"]', "did you mean 'planner'"),
        ('[[hosts]]\nname = "a"\naddress = "a"\nroles = []', "hosts[0].roles"),
        ('[[hosts]]\nname = "a"\naddress = "a"\ncores = 0', "hosts[0].cores"),
        ('[[hosts]]\nname = "a"\naddress = "10.0.0.1:7447"', "the port is `port`, for all"),
        ('[[hosts]]\nname = "A"\naddress = "a"', "of 32 small letters, digits and '-' at most"),
        ('[[hosts]]\nname = "a\\n"\naddress = "a"', "hosts[0].name"),
        ('[[hosts]]\nname = "a"\naddress = "a\\n"', "hosts[0].address"),
        ('[[hosts]]\nname = "a"\naddress = "a"\nroles = ["router", "router"]', "found a role twice"),
        ('[[hosts]]\nname = "a"\naddress = "A"\n[[hosts]]\nname = "b"\naddress = "a"', "2 machines of address 'a'"),
        (
            '[[hosts]]\nname = "a"\naddress = "fd00::1"\n[[hosts]]\nname = "b"\naddress = "fd00:0::1"',
            "2 machines of address 'fd00::1'",
        ),
        ('[[hosts]]\nname = "a"\naddress = "a"\n[[hosts]]\nname = "a"\naddress = "b"', "2 machines of name 'a'"),
        ('[[hosts]]\nname = "a"\naddress = "a"\n[[hosts]]\nname = "b"\naddress = "a"', "2 machines of address 'a'"),
        ('[[hosts]]\nname = "a"\naddress = "127.0.0.1"\n[[hosts]]\nname = "b"\naddress = "b"', "hosts[0].address"),
        ("port = 70000\n" + THREE, "port"),
        ("survive = -1\n" + THREE, "survive"),
        ("hosts = 3", "hosts"),
        ("[hosts", "hosts.toml"),
    ],
)  # fmt: skip
def test_a_file_of_machines_that_cannot_be_is_refused_with_one_sentence(text: str, answer: str) -> None:
    with pytest.raises(ConfigError) as raised:
        parse_hosts(text, "hosts.toml")
    sentence = str(raised.value)
    assert sentence.startswith("hosts.toml")
    assert "\n" not in sentence
    assert answer in sentence


@pytest.mark.parametrize(
    ("text", "standbys", "answer"),
    [
        ('survive = 1\n[[hosts]]\nname = "a"\naddress = "a"', 0, "survive: found 1 with one machine"),
        ("survive = 3\n" + THREE, 0, "'keeper' is among the roles of 3 machines, expected at least 4"),
        (THREE, 3, "'planner' is among the roles of 3 machines, expected at least 4"),
        ('[[hosts]]\nname = "a"\naddress = "a"\nroles = ["router"]', 0, "'keeper' is among the roles of 0"),
    ],
)  # fmt: skip
def test_machines_that_do_not_suffice_are_named(text: str, standbys: int, answer: str) -> None:
    with pytest.raises(ConfigError) as raised:
        make_plan(Scenario(standbys=StandbyConfig(planner=standbys)), parse_hosts(text), "run")
    assert answer in str(raised.value)


def test_an_address_of_version_6_is_written_in_brackets() -> None:
    plan = make_plan(Scenario(), parse_hosts('[[hosts]]\nname = "a"\naddress = "fd00::1"\n' + THREE), "run")
    assert "tls/[fd00::1]:7447" in plan.hosts[1].connect
    assert plan.hosts[0].listen == ("tls/[::]:7447",)


@pytest.mark.parametrize(
    "address",
    [
        "0.0.0.0", "::", "224.0.0.1", "255.255.255.255", "...", "-oProxy", "10.0.0.300", "010.0.0.1",
        "a" * 64, "a..b",
    ],
)  # fmt: skip
def test_an_address_that_nobody_can_reach_is_refused(address: str) -> None:
    with pytest.raises(ConfigError, match="under which others reach it"):
        parse_hosts(f'[[hosts]]\nname = "a"\naddress = "{address}"')
