"""`swarm deploy plan`: what a file of machines may say, and how an impossible demand is answered."""

from __future__ import annotations

import pytest

from launch_scripts.deploy.hosts import parse_hosts
from launch_scripts.deploy.machine_plan import make_plan
from swarm.config.scenario import Scenario, StandbyConfig
from swarm.errors import ConfigError

THREE = "".join(f'[[hosts]]\nname = "m{n}"\naddress = "10.0.0.{n}"\n' for n in (1, 2, 3))


def test_an_address_of_version_6_is_written_in_brackets() -> None:
    plan = make_plan(Scenario(), parse_hosts('[[hosts]]\nname = "a"\naddress = "fd00::1"\n' + THREE), "run")
    assert "tls/[fd00::1]:7447" in plan.hosts[1].connect
    assert plan.hosts[0].listen == ("tls/[::]:7447",)


def test_standbys_need_machines() -> None:
    with pytest.raises(ConfigError, match="'planner' is among the roles of 3 machines, expected at least 4"):
        make_plan(Scenario(standbys=StandbyConfig(planner=3)), parse_hosts(THREE), "run")
