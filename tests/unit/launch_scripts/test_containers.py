"""`swarm deploy plan --kit compose` and `--kit kubernetes`: what is written stands for itself and is whole."""

from __future__ import annotations

import base64
import errno
import stat
import subprocess
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin
from support.manifests import load_all, read_manifests
from typer.testing import CliRunner, Result

from launch_scripts.cli import command
from launch_scripts.commands.deploy import app
from launch_scripts.deploy.certificates import check_signed, hosts_of
from launch_scripts.deploy.containers.container import containers_of, words_of
from launch_scripts.deploy.hosts import parse_hosts
from launch_scripts.deploy.plan import make_plan
from launch_scripts.launcher.options import as_process
from swarm.config.load import load_scenario, parse_scenario
from swarm.errors import ConfigError, StoreError

SCENARIO = """
name = "small"
[terrain]
source = "ground.tif"

[[targets]]
count = 2

[[groups]]
name = "all"
vehicles = 30
"""
HOSTS = """
[[hosts]]
name = "base"
address = "10.0.0.1"

[[hosts]]
name = "north"
address = "10.0.0.2"
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "small.toml").write_text(SCENARIO)
    (tmp_path / "hosts.toml").write_text(HOSTS)
    heights = np.zeros((40, 40), np.float32)
    profile: dict[str, Any] = {"driver": "GTiff", "height": 40, "width": 40, "count": 1, "dtype": "float32"}
    place = from_origin(500_000, 4_000_000, 30, 30)
    with rasterio.open(tmp_path / "ground.tif", "w", **profile, crs="EPSG:32613", transform=place) as file:
        file.write(heights, 1)
    return tmp_path


def plan(folder: Path, *more: str) -> Result:
    words = [
        "plan",
        str(folder / "small.toml"),
        "--hosts",
        str(folder / "hosts.toml"),
        "--out",
        str(folder / "kits"),
    ]
    return CliRunner().invoke(app, [*words, *more], catch_exceptions=True)


def test_the_command_line_takes_the_words_of_every_container() -> None:
    scenario = parse_scenario('[[targets]]\ncount = 2\n[[groups]]\nname = "all"\nvehicles = 30')
    made = make_plan(scenario, parse_hosts(HOSTS), "small-1")
    for each in containers_of(made.hosts):
        role, *words = words_of(each, made.run_id, "0.0.0.0")
        context = command().make_context("swarm", [role, *words], resilient_parsing=True)
        taken = command().get_command(context, role).make_context(role, words).params
        assert taken["health_port"] == 9464
        assert taken["signals_address"] == "0.0.0.0"
        assert taken["log_format"] == "json"
        assert taken["scenario"] == "/etc/swarm/scenario.toml"


def test_a_machine_of_containers_has_all_that_its_compose_file_names_and_no_launchers_key(folder: Path) -> None:
    done = plan(folder, "--kit", "compose")
    assert done.exit_code == 0, done.output
    for host in ("base", "north"):
        with tarfile.open(folder / "kits" / f"{host}.tar.gz") as archive:
            archive.extractall(folder, filter="data")
        kit = folder / f"swarm-{host}"
        (compose,) = load_all((kit / "compose.yaml").read_text())
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


def test_manifests_come_with_their_keys_apart_and_a_recipe_that_adds_the_ground(folder: Path) -> None:
    done = plan(folder, "--kit", "kubernetes", "--image", "registry/small:1")
    assert done.exit_code == 0, done.output
    kit = folder / "kits" / "kubernetes"
    assert f"kubectl apply -f {kit}" in done.output.replace("\n", "")
    assert stat.S_IMODE((kit / "secrets.yaml").stat().st_mode) == 0o600
    manifests = read_manifests(*(path.read_text() for path in kit.glob("*.yaml")))
    assert (folder / "kits" / "certs" / "operator.0.key").is_file()
    images = {pod["spec"]["containers"][0]["image"] for pod in manifests.pods.values()}
    assert images == {"registry/small:1", "registry/small:1-all"}
    assert (kit / "ground" / "0" / "ground.tif").read_bytes() == (folder / "ground.tif").read_bytes()
    assert "COPY ground /etc/swarm/ground" in (kit / "Containerfile").read_text()
    for secret in manifests.of("Secret"):
        files = {name: folder / name for name in secret["data"]}
        for name, path in files.items():
            path.write_bytes(base64.b64decode(secret["data"][name]))
        (key,) = [path for name, path in files.items() if name.endswith(".key")]
        check_signed(files["ca.pem"], key.with_suffix(".pem"), key)


def test_manifests_of_a_second_plan_are_whole_and_leave_nothing_of_the_first(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kit = folder / "kits" / "kubernetes"
    done = plan(folder, "--kit", "kubernetes")
    assert done.exit_code == 0, done.output
    assert "Containerfile: adds the ground" in done.output.replace("\n", "")
    before = {path: path.read_bytes() for path in kit.rglob("*") if path.is_file()}

    def full(_: Path, __: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr("shutil.copyfile", full)
        done = plan(folder, "--kit", "kubernetes")
    assert isinstance(done.exception, StoreError)
    assert str(done.exception) == f"cannot write {kit}: {folder / 'kits'}: No space left on device"
    assert before.keys() == {path for path in kit.rglob("*") if path.is_file()}
    (kit / "own.yaml").write_text("")
    scenario = folder / "small.toml"
    scenario.write_text(scenario.read_text().replace("ground.tif", "synthetic"))
    done = plan(folder, "--kit", "kubernetes")
    assert done.exit_code == 0, done.output
    assert "Containerfile" not in done.output
    assert {path.name for path in kit.rglob("*") if path.is_file()} == {"own.yaml", "secrets.yaml", "swarm.yaml"}


def test_a_wheel_is_refused_where_containers_have_an_image(folder: Path) -> None:
    (folder / "swarm.whl").write_bytes(b"")
    done = plan(folder, "--kit", "compose", "--wheel", str(folder / "swarm.whl"))
    assert isinstance(done.exception, ConfigError)
    assert "--wheel: found" in str(done.exception)
