"""The archives of `swarm deploy plan`: each machine gets its own files, and its start files are sound."""

import datetime
import re
import shutil
import stat
import subprocess
import sys
import tarfile
from pathlib import Path

import pytest
import yaml
from support.command import Swarm

from launch_scripts.deploy import certificates
from launch_scripts.deploy.certificates import authority, called_of, check_signed, ends_on, hosts_of, issue
from launch_scripts.deploy.machine_archives import UNIT, keep_plan, keepers_before, systemd_files, write_kits
from launch_scripts.deploy.machine_plan import HostsConfig, Plan, make_plan, parse_hosts
from launch_scripts.launcher.run_options import as_process, chosen_processes
from swarm.config.revocations import revoke
from swarm.config.scenario_files import load_scenario, parse_scenario
from swarm.errors import StoreError

SCENARIO = 'name = "small"\n[[targets]]\ncount = 2\n[[groups]]\nvehicles = 12\n[vehicles]\nper_agent = 3\n'
ON_GROUND = (
    SCENARIO + '[terrain]\nsource = "hill.asc"\n[[cost.zones]]\nkind = "forbidden"\nfile = "parks/hill.shp"\n'
)
EXPOSURE = 15
"""Tenths, in the words of `systemd-analyze security`, of 100; newer versions may count more."""


def hosts(*addresses: str) -> HostsConfig:
    rows = (f'[[hosts]]\nname = "m{n}"\naddress = "{address}"\n' for n, address in enumerate(addresses))
    return parse_hosts("".join(rows))


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


def test_systemd_finds_nothing_wrong_with_the_unit(tmp_path: Path) -> None:
    done = analyze(tmp_path, "verify", "--man=no")
    assert (done.returncode, done.stdout + done.stderr) == (0, "")


def test_the_service_is_shut_off_from_the_rest_of_the_machine(tmp_path: Path) -> None:
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
    machines = (f'[[hosts]]\nname = "{name}"\naddress = "10.0.0.{n}"\n' for n, name in enumerate(("base", "north")))
    (tmp_path / "hosts.toml").write_text("".join(machines))
    (tmp_path / "swarm.whl").write_bytes(b"")
    line = f"deploy plan {tmp_path}/small.toml --hosts {tmp_path}/hosts.toml --out {tmp_path}/kits --kit compose"
    assert "--wheel: found" in swarm(f"{line} --wheel {tmp_path}/swarm.whl")[2], "containers have an image"
    assert swarm(line)[0] == 0
    for host in ("base", "north"):
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
