"""The archives of `swarm deploy plan`: each machine gets its own files, and its start files are sound."""

import datetime
import json
import re
import shutil
import stat
import subprocess
import sys
import tarfile
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import msgspec
import pytest
import yaml
from cryptography import x509
from support.command import Swarm

from launch_scripts.commands.shared_options import Tls
from launch_scripts.deploy import certificates
from launch_scripts.deploy.certificates import (
    THIS_MACHINE,
    authority,
    called_of,
    check_signed,
    ends_on,
    hosts_of,
    issue,
)
from launch_scripts.deploy.machine_archives import (
    UNIT,
    keep_plan,
    keepers_before,
    systemd_files,
    write_kits,
    zenohd_config,
)
from launch_scripts.deploy.machine_plan import HostsConfig, Plan, make_plan, parse_hosts
from launch_scripts.launcher.run_options import as_process, chosen_processes
from launch_scripts.process_table import LAUNCHER, certificate_name, certificate_names, processes_of
from launch_scripts.simulation.sample_worlds import SMALL
from launch_scripts.simulation.simulate import Simulation
from swarm.bus.memory_bus import MemoryBus
from swarm.bus.zenoh_config import access_control, bearer, common_name, low_pass_filter
from swarm.config.revocations import revoke
from swarm.config.scenario import GroupConfig, NetworkConfig, Scenario, StandbyConfig, TargetConfig, TlsConfig
from swarm.config.scenario_files import load_scenario, parse_scenario
from swarm.errors import ConfigError, StoreError
from swarm.wire.topics import Topic

SCENARIO = 'name = "small"\n[[targets]]\ncount = 2\n[[groups]]\nvehicles = 12\n[vehicles]\nper_agent = 3\n'
ON_GROUND = (
    SCENARIO + '[terrain]\nsource = "hill.asc"\n[[cost.zones]]\nkind = "forbidden"\nfile = "parks/hill.shp"\n'
)
EXPOSURE = 15
"""Tenths, in the words of `systemd-analyze security`, of 100; newer versions may count more."""


def rows(*addresses: str) -> str:
    """The text of a file of hosts, called m0, m1 and so on."""
    return "".join(f'[[hosts]]\nname = "m{n}"\naddress = "{address}"\n' for n, address in enumerate(addresses))


def hosts(*addresses: str) -> HostsConfig:
    return parse_hosts(rows(*addresses))


THREE = hosts("10.0.0.1", "10.0.0.2", "10.0.0.3")


def planned(text: str = SCENARIO, machines: HostsConfig = THREE, base: Path | None = None) -> Plan:
    return make_plan(parse_scenario(text, base=base), machines, "small-1")


def unpacked(plan: Plan, out: Path) -> list[Path]:
    """Writes archives and unpacks them; the folder of each machine."""
    archives = write_kits(plan, out, 7)
    for archive in archives:
        assert stat.S_IMODE(archive.stat().st_mode) == 0o600
        with tarfile.open(archive) as file:
            file.extractall(out / "unpacked", filter="data")
    return [out / "unpacked" / f"swarm-{host.name}" for host in plan.hosts]


def lay_ground(folder: Path) -> tuple[str, ...]:
    """Names of the files that belong to `ON_GROUND`, which are made beside another one."""
    (folder / "parks").mkdir()
    own = ("hill.asc", "hill.prj", "parks/hill.shp", "parks/hill.dbf", "parks/hill.prj")
    for name in (*own, "hill.toml"):
        (folder / name).write_text(name)
    return own


def test_an_address_of_version_6_is_written_in_brackets() -> None:
    first, other, *_ = planned(machines=hosts("fd00::1", "10.0.0.1", "10.0.0.2")).hosts
    assert "tls/[fd00::1]:7447" in other.connect
    assert first.listen == ("tls/[::]:7447",)


def test_each_machine_has_the_keys_of_its_own_processes_and_no_other(tmp_path: Path) -> None:
    plan = planned()
    folders = unpacked(plan, tmp_path)
    keys: list[bytes] = []
    for host, folder in zip(plan.hosts, folders, strict=True):
        certs = folder / "certs"
        names = {process.certificate for process in host.processes} | {"operator.0"}
        assert {path.stem for path in certs.glob("*.key")} == names
        assert {path.stem for path in certs.glob("*.pem")} == {*names, "ca"}
        for name in names:
            check_signed(certs / "ca.pem", certs / f"{name}.pem", certs / f"{name}.key")
            assert stat.S_IMODE((certs / f"{name}.key").stat().st_mode) == 0o600
        assert called_of(certs / "operator.0.pem") == f"operator.{host.name}"
        (router,) = host.of("router")
        assert hosts_of(certs / f"{router.certificate}.pem") == {
            host.address,
            f"router-{host.name}",
            "localhost",
            "127.0.0.1",
        }
        keys += [path.read_bytes() for path in certs.glob("*.key")]
    assert len(keys) == len(set(keys))


def test_a_second_plan_keeps_keys_that_need_not_be_others(tmp_path: Path) -> None:
    certs = tmp_path / "certs"

    def keys() -> dict[str, bytes]:
        return {path.stem: path.read_bytes() for path in certs.glob("*.key")}

    write_kits(planned(), tmp_path, 7)
    before = keys()
    write_kits(planned(machines=hosts("10.0.0.1", "10.0.0.9", "10.0.0.3")), tmp_path, 7)
    assert {name for name, key in keys().items() if key != before[name]} == {"router.1"}
    before = keys()
    revoke(certs, ["agent.all.a0"])
    (first, *_) = unpacked(planned(), tmp_path)
    assert {name for name, key in keys().items() if key != before[name]} == {"router.1", "agent.all.a0"}
    assert called_of(certs / "agent.all.a0.pem") == "agent.all.a0~2"
    assert (first / "certs" / "revoked").read_text() == "agent.all.a0\n"


@pytest.mark.parametrize("start_days", [-20, 20])
def test_an_authority_that_is_not_valid_today_signs_and_checks_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, start_days: int
) -> None:
    certs = tmp_path / "certs"
    with monkeypatch.context() as patched:
        patched.setattr(certificates, "_CLOCKS_DIFFER", datetime.timedelta(days=-start_days))
        patched.setattr(certificates, "_CA_DAYS", start_days + 10)
        authority(certs)
    with pytest.raises(StoreError, match=r"ca\.pem is good from .* not today; make an authority and all"):
        write_kits(planned(), tmp_path, 7)
    assert not list(tmp_path.glob("*.tar.gz"))


def test_no_certificate_outlives_its_authority(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine that refuses an authority refuses all that it has signed."""
    monkeypatch.setattr(certificates, "_CA_DAYS", 3)
    path = issue(tmp_path, "a0", [], 365)
    assert ends_on(path) == ends_on(tmp_path / "ca.pem")
    monkeypatch.setattr(
        certificates,
        "_in_days",
        lambda days: datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=days + 4),
    )
    with pytest.raises(StoreError, match=r"ca\.pem is good from"):
        check_signed(tmp_path / "ca.pem", path, path.with_suffix(".key"))


def test_archives_of_machines_that_are_gone_are_removed_and_no_other_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_kits(planned(), tmp_path, 7)
    (tmp_path / "mine.tar.gz").write_text("")
    assert capsys.readouterr().err == ""
    write_kits(planned(machines=hosts("10.0.0.1", "10.0.0.2")), tmp_path, 7)
    assert {path.name for path in tmp_path.glob("*.gz")} == {"m0.tar.gz", "m1.tar.gz", "mine.tar.gz"}
    assert (
        capsys.readouterr().err == f"{tmp_path / 'm2.tar.gz'}: removed, as the plan has no machine of this name\n"
    )


def test_no_archive_outside_of_the_folder_is_removed(tmp_path: Path) -> None:
    (tmp_path / "mine.tar.gz").write_text("")
    out = tmp_path / "kits"
    write_kits(planned(), out, 7)
    text = (out / "plan.json").read_text()
    (out / "plan.json").write_text(text.replace('"name": "m2"', '"name": "../mine"'))
    with pytest.raises(StoreError, match=r"plan\.json is no plan of `swarm deploy plan`"):
        keep_plan(planned(), out)
    assert (tmp_path / "mine.tar.gz").exists()


def test_a_machine_reads_the_plans_scenario_with_its_own_endpoints_and_starts_its_processes(tmp_path: Path) -> None:
    plan = planned()
    for host, folder in zip(plan.hosts, unpacked(plan, tmp_path), strict=True):
        scenario = load_scenario(folder / "scenario.toml")
        assert scenario.network.listen == host.listen
        assert scenario.network.connect == host.connect
        assert scenario.network.peers == host.peers
        assert scenario.network.admit == plan.scenario.network.admit
        assert scenario.standbys == plan.scenario.standbys
        assert (scenario.targets, scenario.groups) == (plan.scenario.targets, plan.scenario.groups)
        words = re.findall(r"--only (\S+)", (folder / "run").read_text())
        assert words == re.findall(r"--only (\S+)", (folder / UNIT).read_text())
        started = [(spec.role, spec.id) for spec in chosen_processes(scenario, words, None)]
        assert started == [(process.role, process.id) for process in host.processes]


def test_terrain_files_go_to_keepers_and_the_targets_process_with_all_that_belongs_to_them(tmp_path: Path) -> None:
    own = lay_ground(tmp_path)
    plan = planned(ON_GROUND, base=tmp_path)
    folders = unpacked(plan, tmp_path / "kits")
    having = [host.has_files for host in plan.hosts]
    assert sorted(having) == [False, True, True]
    for has, folder in zip(having, folders, strict=True):
        found = {str(path.relative_to(folder)): path.read_text() for path in folder.rglob("hill.*")}
        assert sorted(found.values()) == (sorted(own) if has else [])
        scenario = load_scenario(folder / "scenario.toml")
        named = [scenario.terrain.source, scenario.cost.zones[0].file]
        beside = [
            Path(str(name)).with_suffix(suffix) for name in named for suffix in (Path(str(name)).suffix, ".prj")
        ]
        asked = [path.read_text() for path in beside if path.is_file()]
        assert asked == (["hill.asc", "hill.prj", "parks/hill.shp", "parks/hill.prj"] if has else [])


def test_modules_of_plug_ins_lie_beside_the_scenario(tmp_path: Path) -> None:
    (tmp_path / "zigzag.py").write_text("import helper\n")
    (tmp_path / "helper.py").write_text("")
    text = SCENARIO.replace("count = 2", 'count = 2\nwalk = "zigzag:Walk"')
    for folder in unpacked(planned(text, base=tmp_path), tmp_path / "kits"):
        assert sorted(path.name for path in (folder / "plugins").iterdir()) == ["helper.py", "zigzag.py"]
        assert load_scenario(folder / "scenario.toml").plugin_folder == str(folder / "plugins")


def test_install_puts_files_where_the_unit_looks_for_them_and_takes_over_a_new_plan(tmp_path: Path) -> None:
    root, plan = tmp_path / "root", planned()
    for _ in range(2):
        folder = unpacked(plan, tmp_path)[0]
        home = root / "etc/swarm"
        # Unpacked over the archive of an earlier plan.
        for left in ("certs/planner.old.key", "plugins/old.py", "wheels/old.whl"):
            (folder / left).parent.mkdir(exist_ok=True)
            (folder / left).write_text("of an earlier plan")
        if home.exists():
            (home / "certs" / "agent.all.old.key").write_text("of an earlier plan")
            (home / "certs" / "revoked").write_text("agent.all.a9\n")
        done = subprocess.run(
            [str(folder / "install")], env={"PATH": "/usr/bin:/bin", "DESTDIR": str(root)}, capture_output=True,
            text=True, check=False, timeout=30,
        )  # fmt: skip
        assert (done.returncode, done.stderr) == (0, "")
        revoke(tmp_path / "certs", ["agent.all.a3"])
    names = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    assert names == {*(folder / "contents").read_text().split(), "contents"}
    assert not list((home / "plugins").glob("*"))
    assert {path.name for path in (home / "certs").iterdir()} == {
        *(path.name for path in (folder / "certs").iterdir()), "revoked",
    }  # fmt: skip
    assert set((home / "certs" / "revoked").read_text().split()) == {"agent.all.a3", "agent.all.a9"}
    assert not any(stat.S_IMODE(path.stat().st_mode) & 0o007 for path in (home, *home.rglob("*")))
    unit = (root / "etc/systemd/system" / UNIT).read_text()
    assert f"ExecStart=/opt/swarm/bin/swarm up /{home.relative_to(root)}/scenario.toml" in unit


def analyze(tmp_path: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """`systemd-analyze` on the unit of a machine, with a program that is there in place of the swarm's."""
    if shutil.which("systemd-analyze") is None:
        pytest.skip("there is no systemd-analyze (package systemd)")
    plan = planned()
    path = tmp_path / UNIT
    path.write_text(systemd_files(plan, plan.hosts[0])[UNIT].replace("/opt/swarm/bin/swarm", sys.executable))
    return subprocess.run(
        ["systemd-analyze", *arguments, str(path)], capture_output=True, text=True, check=False, timeout=60
    )


def test_systemd_finds_the_unit_sound_and_shut_off_from_the_rest_of_the_machine(tmp_path: Path) -> None:
    done = analyze(tmp_path, "verify", "--man=no")
    assert (done.returncode, done.stdout + done.stderr) == (0, "")
    done = analyze(tmp_path, "security", "--offline=true", "--no-pager", f"--threshold={EXPOSURE}")
    assert done.returncode == 0, done.stdout + done.stderr


def test_what_lies_in_the_folder_of_a_plan_before_is_read_as_one(tmp_path: Path) -> None:
    plan = planned()
    assert keepers_before(tmp_path, plan.run_id) == {}
    write_kits(plan, tmp_path, 7)
    keepers = {keeper.id: host.name for host in plan.hosts for keeper in host.of("keeper")}
    assert keepers_before(tmp_path, plan.run_id) == keepers
    assert keepers_before(tmp_path, "another-run") == {}
    (tmp_path / "plan.json").write_text("[]")
    with pytest.raises(
        StoreError, match=r"plan\.json is no plan of `swarm deploy plan`: .*; write to another folder"
    ):
        keepers_before(tmp_path, plan.run_id)


def test_a_machine_of_containers_has_all_that_its_compose_file_names_and_no_launchers_key(
    tmp_path: Path, swarm: Swarm
) -> None:
    lay_ground(tmp_path)
    (tmp_path / "small.toml").write_text(ON_GROUND)
    (tmp_path / "hosts.toml").write_text(rows("10.0.0.1", "10.0.0.2"))
    (tmp_path / "swarm.whl").write_bytes(b"")
    line = f"deploy plan {tmp_path}/small.toml --hosts {tmp_path}/hosts.toml --out {tmp_path}/kits --kit compose"
    assert "--wheel: found" in swarm(f"{line} --wheel {tmp_path}/swarm.whl")[2], "containers have an image"
    assert swarm(line)[0] == 0
    for host in ("m0", "m1"):
        with tarfile.open(tmp_path / "kits" / f"{host}.tar.gz") as archive:
            archive.extractall(tmp_path, filter="data")
        kit = tmp_path / f"swarm-{host}"
        compose = yaml.safe_load((kit / "compose.yaml").read_text())
        for service in compose["services"].values():
            for volume in service["volumes"]:
                assert volume["type"] != "bind" or (kit / volume["source"]).exists()
        assert all((kit / secret["file"]).is_file() for secret in compose["secrets"].values())
        assert not (kit / "certs" / "operator.0.key").exists()
        scenario = load_scenario(kit / "scenario.toml")
        for name, service in compose["services"].items():
            role, _, id = name.replace("--", ".").partition("-")
            tls = as_process(scenario, role, id).network.tls
            assert tls is not None
            given = {secret["source"] for secret in service["secrets"]}
            assert {Path(tls.certificate).name, Path(tls.key).name, "ca.pem"} == given
            check_signed(Path(tls.ca), Path(tls.certificate), Path(tls.key))
            if role == "router":
                assert hosts_of(Path(tls.certificate)) >= {f"router-{host}"}
        assert stat.S_IMODE((kit / "install").stat().st_mode) == 0o755
        assert subprocess.run(["sh", "-n", kit / "install"], timeout=20).returncode == 0


# --- the commands: a certificate for each process of a scenario, a configuration for zenohd, a sentence per fault -


ADMITTING = """
terrain.source = "synthetic"
targets = [{ count = 2 }]
groups = [{ vehicles = 30 }]
[network]
admit = ["operator.anna"]
"""


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    path = tmp_path / "my.toml"
    path.write_text(ADMITTING)
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


def test_what_a_scenario_needs_is_made_again_if_it_ends_soon_with_the_hosts_that_it_had_or_is_revoked(
    tmp_path: Path, scenario: Path, swarm: Swarm, monkeypatch: pytest.MonkeyPatch
) -> None:
    certs, revoked = tmp_path / "certs", "agent.all.a0"
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
    made = {path: path.read_bytes() for path in certs.iterdir()}
    assert swarm("deploy certs", certs, "--scenario", scenario)[0] == 0
    assert {path: path.read_bytes() for path in certs.iterdir()} == made
    scenario.write_text(scenario.read_text() + f'revoked = ["{revoked}"]\n')
    assert swarm("deploy certs", certs, "--scenario", scenario)[0] == 0
    assert called_of(certs / f"{revoked}.pem") == f"{revoked}~2"
    assert {path.stem for path, was in made.items() if path.read_bytes() != was} == {revoked}


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
    hosts, kits = tmp_path / "hosts.toml", tmp_path / "kits"
    hosts.write_text(rows("10.0.0.1", "10.0.0.2", "10.0.0.3"))
    code, shown, _ = swarm("deploy plan", scenario, "--hosts", hosts)
    assert code == 0
    assert {"m0", "m1", "m2"} <= set(shown.split())
    assert "the run survives the loss of any 1 of its 3 machines; the vehicles of a lost machine stop" in shown
    assert " records the run and writes its report" in shown
    assert not kits.exists()
    plan = json.loads(swarm("deploy plan", scenario, "--hosts", hosts, "--out", kits, "--json")[1])
    assert plan["archives"] == [str(kits / f"m{n}.tar.gz") for n in range(3)]
    names = [process["certificate"] for host in plan["hosts"] for process in host["processes"]]
    assert {path.stem for path in (kits / "certs").glob("*.key")} == {
        "ca", "operator.0", *(f"operator.m{n}" for n in range(3)), *names,
    }  # fmt: skip
    assert "operator.anna" not in names


# --- access control on paper: what processes do is what the table grants them, and names are what they must be ----


TLS = TlsConfig(ca="ca.pem", certificate="router.0.pem", key="router.0.key")


def includes(expression: str, other: str) -> bool:
    """Zenoh's wildcards inside a chunk and for a chunk; `**` stands at the end only."""
    pattern = re.escape(expression).replace(r"\$\*", "[^/]*").replace(r"\*\*", ".*").replace(r"\*", "[^/]+")
    return re.fullmatch(pattern, other) is not None


def allowed(control: dict[str, Any], name: str, flow: str, message: str, key: str) -> bool:
    """The decision of a router, by the name in a certificate."""
    subjects = [each["id"] for each in control["subjects"] if name in each.get("cert_common_names", ())]
    rules = [
        rule for each in control["policies"] if set(each["subjects"]) & set(subjects) for rule in each["rules"]
    ]
    return any(
        flow in rule["flows"] and message in rule["messages"] and any(includes(k, key) for k in rule["key_exprs"])
        for rule in control["rules"]
        if rule["id"] in rules
    )


def test_processes_do_nothing_that_the_router_would_deny(monkeypatch: pytest.MonkeyPatch) -> None:
    targets = (msgspec.structs.replace(SMALL.targets[0], tracker="sighted"), TargetConfig(name="x"))
    vehicles = msgspec.structs.replace(SMALL.vehicles, sense_range_m=400.0)
    standbys = StandbyConfig(planner=1, targets=1)
    scenario = msgspec.structs.replace(SMALL, targets=targets, vehicles=vehicles, standbys=standbys)
    done: set[tuple[str, str, str]] = set()
    for method, message in {
        "publish": "put", "subscribe": "declare_subscriber", "serve": "declare_queryable", "ask": "query",
    }.items():  # fmt: skip
        note(monkeypatch, method, message, done)
    Simulation(scenario).run_until(6)
    names = certificate_names(scenario)
    control = access_control("swarm", names)
    whose = {node: certificate_name(scenario, *node.split("-", 1)) for node, *_ in done}
    watching = {node for node in whose if whose[node] not in names}
    assert {whose[node].partition(".")[0] for node in whose} >= {"keeper", "planner", "agent", "targets"}
    assert {message for _, message, _ in done} == {"put", "declare_subscriber", "declare_queryable", "query"}
    denied = {
        (node, message, key)
        for node, message, key in done
        if not allowed(control, "operator.0" if node in watching else whose[node], "ingress", message, key)
    }
    assert denied == set()


def note(monkeypatch: pytest.MonkeyPatch, method: str, message: str, done: set[tuple[str, str, str]]) -> None:
    """Adds to `done` what processes call: (node, Zenoh's name of the message, key expression)."""
    real = getattr(MemoryBus, method)

    def noted(bus: MemoryBus, topic: Topic, *args: Any, **kwargs: Any) -> None:
        fields: Mapping[str, str | int] = {name: kwargs[name] for name in topic.fields if name in kwargs}
        done.add((bus.node, message, topic.expression("swarm", **fields)))
        real(bus, topic, *args, **kwargs)

    monkeypatch.setattr(MemoryBus, method, noted)


def test_every_process_of_a_scenario_has_a_name_and_what_the_scenario_admits_beside_them() -> None:
    scenario = Scenario(
        groups=(GroupConfig(name="a.b", vehicles=30), GroupConfig(name="red", vehicles=2)),
        targets=(TargetConfig(name="t", count=2), TargetConfig(name="real", walk="external")),
        network=NetworkConfig(admit=("keeper.east", "operator.anna", "keeper.0")),
    )
    assert certificate_names(scenario) == [
        "router.0", "keeper.0", "monitor.0", "planner.t0", "planner.t1", "planner.real", "targets.0",
        "agent.a.b.a0", "agent.a.b.a1", "agent.red.a2", "tracker.real", "operator.0", "keeper.east",
        "operator.anna",
    ]  # fmt: skip
    standing_by = msgspec.structs.replace(scenario, standbys=StandbyConfig(planner=1, targets=2))
    assert set(certificate_names(standing_by)) - set(certificate_names(scenario)) == {
        "planner.t0.r1", "planner.t1.r1", "planner.real.r1", "targets.0.r1", "targets.0.r2",
    }  # fmt: skip
    agent = bearer("agent.a.b.a1")
    assert (agent.role, agent.id, agent.author) == ("agent", "a1", "a.b.a1")


@pytest.mark.parametrize(
    "name",
    ["router", "car1", "agent.a0", "agent..a0", "agent.all.", "keeper.", "pilot.x", "keeper.a/b", "keeper.*", ""],
)
def test_a_name_that_no_process_can_have_is_refused(name: str) -> None:
    with pytest.raises(ConfigError):
        bearer(name)
    with pytest.raises(ConfigError):
        access_control("swarm", [name])


def test_who_is_revoked_may_do_nothing_and_its_successor_what_it_might() -> None:
    key, was = "swarm/stats/agent/a0", "agent.all.a0"
    for revoked, may in (((), was), ((was,), f"{was}~2"), ((was, f"{was}~2"), f"{was}~3")):
        assert common_name(was, revoked) == may
        control = access_control("swarm", ["keeper.0", was], revoked)
        names = [was, *(f"{was}~{n}" for n in range(1, 5))]
        assert [name for name in names if allowed(control, name, "ingress", "put", key)] == [may]


@pytest.mark.parametrize("names", [(), ("keeper.0",)])
def test_with_certificates_zenohd_and_our_router_have_the_same_rules_and_without_there_are_none(
    names: Collection[str],
) -> None:
    secured = NetworkConfig(admit=tuple(names), tls=TLS)
    control = zenohd_config(secured)["access_control"]
    assert control == access_control("swarm", names)
    assert control["default_permission"] == "deny"
    plain = zenohd_config(msgspec.structs.replace(secured, tls=None))
    assert "access_control" not in plain
    assert plain["low_pass_filter"] == low_pass_filter(secured.namespace)
