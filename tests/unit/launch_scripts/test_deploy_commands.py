"""`swarm deploy`: a certificate for each process of a scenario, a configuration for zenohd, a sentence per
fault."""

import datetime
import json
from pathlib import Path

import pytest
from cryptography import x509
from support.command import Swarm

from launch_scripts.commands.shared_options import Tls
from launch_scripts.deploy import certificates
from launch_scripts.deploy.certificates import THIS_MACHINE, called_of, check_signed, hosts_of
from launch_scripts.launcher.run_options import as_process
from launch_scripts.process_table import LAUNCHER, certificate_names, processes_of
from swarm.config.scenario_files import load_scenario
from swarm.errors import ConfigError

SCENARIO = """
terrain.source = "synthetic"
targets = [{ count = 2 }]
groups = [{ vehicles = 30 }]
[network]
admit = ["operator.anna"]
"""


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    path = tmp_path / "my.toml"
    path.write_text(SCENARIO)
    return path


def test_every_process_of_a_scenario_gets_a_certificate_and_finds_its_own(
    tmp_path: Path, scenario: Path, swarm: Swarm
) -> None:
    certs = tmp_path / "certs"
    assert swarm("deploy certs", certs, "--scenario", scenario, "router.0=10.0.0.1")[0] == 0
    loaded = load_scenario(scenario)
    names = certificate_names(loaded)
    assert {path.stem for path in certs.glob("*.pem")} == {"ca", *names}
    assert {called_of(certs / f"{name}.pem") for name in names} == set(names)
    router = x509.load_pem_x509_certificate((certs / "router.0.pem").read_bytes())
    hosts = router.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert [str(host.value) for host in hosts] == ["10.0.0.1", "localhost", "127.0.0.1"]
    assert not router.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    assert 364 <= (router.not_valid_after_utc - datetime.datetime.now(datetime.UTC)).days <= 365
    files = Tls(None, str(certs / "ca.pem"), str(certs), str(certs)).tls()
    scenario.write_text(
        scenario.read_text() + f'tls = {{ca = "{files.ca}", certificate = "certs", key = "certs"}}\n'
    )
    loaded = load_scenario(scenario)
    for spec in processes_of(loaded):
        own = as_process(loaded, spec.role, spec.id).network.tls
        assert called_of(Path(own.certificate)) in names
        assert Path(own.key) == Path(own.certificate).with_suffix(".key")
    assert as_process(loaded, LAUNCHER, "0").network.tls != as_process(loaded, "keeper", "0").network.tls
    with pytest.raises(ConfigError, match=r"certs/keeper.west.pem, which keeper.west needs"):
        as_process(loaded, "keeper", "west")


def test_what_is_there_stays_and_a_revoked_name_gets_its_next_number(
    tmp_path: Path, scenario: Path, swarm: Swarm
) -> None:
    certs, revoked = tmp_path / "certs", "agent.all.a0"
    swarm("deploy certs", certs, "--scenario", scenario)
    before = {path: path.read_bytes() for path in certs.iterdir()}
    assert swarm("deploy certs", certs, "--scenario", scenario)[0] == 0
    assert {path: path.read_bytes() for path in certs.iterdir()} == before
    scenario.write_text(scenario.read_text() + f'revoked = ["{revoked}"]\n')
    assert swarm("deploy certs", certs, "--scenario", scenario)[0] == 0
    assert called_of(certs / f"{revoked}.pem") == f"{revoked}~2"
    changed = {path.stem for path, was in before.items() if path.read_bytes() != was}
    assert changed == {revoked}


def test_what_a_scenario_needs_and_ends_soon_is_made_again_with_the_hosts_that_it_had(
    tmp_path: Path, scenario: Path, swarm: Swarm, monkeypatch: pytest.MonkeyPatch
) -> None:
    certs = tmp_path / "certs"
    with monkeypatch.context() as earlier:
        earlier.setattr(certificates, "_CLOCKS_DIFFER", datetime.timedelta(days=20))
        swarm(
            "deploy certs", certs, "router.0=10.0.0.1,base.local", "keeper.0", "--days", 9
        )  # less than a third is left
        swarm("deploy certs", certs, "planner.t0", "--days", 11)
    before = {path.stem: path.read_bytes() for path in certs.glob("*.pem")}
    assert swarm("deploy certs", certs, "--scenario", scenario)[0] == 0
    changed = {name for name, was in before.items() if (certs / f"{name}.pem").read_bytes() != was}
    assert changed == {"router.0", "keeper.0"}
    assert hosts_of(certs / "router.0.pem") == {"10.0.0.1", "base.local", *THIS_MACHINE}
    for name in before:
        check_signed(certs / "ca.pem", certs / f"{name}.pem", certs / f"{name}.key")


def test_zenohd_admits_the_processes_of_a_scenario_and_needs_certificates(
    tmp_path: Path, scenario: Path, swarm: Swarm
) -> None:
    certs, out = tmp_path / "certs", tmp_path / "zenohd.json5"
    swarm("deploy certs", certs, "--scenario", scenario)
    files = ("--tls-ca", certs / "ca.pem", "--tls-cert", certs, "--tls-key", certs)
    told = swarm("deploy zenohd --out", out, "--listen", "tls/0.0.0.0:7447", *files)
    assert told[0] == 2
    assert swarm("deploy zenohd --out", out, "--listen", "tls/0.0.0.0:7447", *files, "--scenario", scenario)[0] == 0
    config = json.loads(out.read_text())
    named = {name for each in config["access_control"]["subjects"] for name in each.get("cert_common_names", ())}
    assert named == set(certificate_names(load_scenario(scenario)))
    assert config["transport"]["link"]["tls"]["listen_certificate"] == str(certs / "router.0.pem")
    assert swarm("deploy zenohd --out", out, "--force", "--listen", "tcp/127.0.0.1:7447")[0] == 0
    assert "access_control" not in json.loads(out.read_text())


def test_a_plan_is_shown_and_written_for_each_machine(tmp_path: Path, scenario: Path, swarm: Swarm) -> None:
    machines = "".join(f'[[hosts]]\nname = "m{n}"\naddress = "10.0.0.{n}"\n' for n in (1, 2, 3))
    hosts, kits = tmp_path / "hosts.toml", tmp_path / "kits"
    hosts.write_text(machines)
    code, shown, _ = swarm("deploy plan", scenario, "--hosts", hosts)
    assert code == 0
    assert {"m1", "m2", "m3"} <= set(shown.split())
    assert "the run survives the loss of any 1 of its 3 machines; the vehicles of a lost machine stop" in shown
    assert " records the run and writes its report" in shown
    assert not kits.exists()
    plan = json.loads(swarm("deploy plan", scenario, "--hosts", hosts, "--out", kits, "--json")[1])
    assert plan["archives"] == [str(kits / f"m{n}.tar.gz") for n in (1, 2, 3)]
    names = [process["certificate"] for host in plan["hosts"] for process in host["processes"]]
    assert {path.stem for path in (kits / "certs").glob("*.key")} == {
        "ca", "operator.0", *(f"operator.m{n}" for n in (1, 2, 3)), *names,
    }  # fmt: skip
    assert "operator.anna" not in names
