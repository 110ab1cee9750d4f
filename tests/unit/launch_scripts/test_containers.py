"""`swarm deploy plan --kit compose`: the written files are whole and need no others."""

from __future__ import annotations

import stat
import subprocess
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import yaml
from rasterio.transform import from_origin
from typer.testing import CliRunner, Result

from launch_scripts.commands.deploy_commands import app
from launch_scripts.deploy.certificates import check_signed, hosts_of
from launch_scripts.launcher.options import as_process
from swarm.config.load import load_scenario
from swarm.errors import ConfigError

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
    line = f"plan {folder}/small.toml --hosts {folder}/hosts.toml --out {folder}/kits"
    return CliRunner().invoke(app, [*line.split(), *more], catch_exceptions=True)


def test_a_machine_of_containers_has_all_that_its_compose_file_names_and_no_launchers_key(folder: Path) -> None:
    done = plan(folder, "--kit", "compose")
    assert done.exit_code == 0, done.output
    for host in ("base", "north"):
        with tarfile.open(folder / "kits" / f"{host}.tar.gz") as archive:
            archive.extractall(folder, filter="data")
        kit = folder / f"swarm-{host}"
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


def test_a_wheel_is_refused_where_containers_have_an_image(folder: Path) -> None:
    (folder / "swarm.whl").write_bytes(b"")
    done = plan(folder, "--kit", "compose", "--wheel", str(folder / "swarm.whl"))
    assert isinstance(done.exception, ConfigError)
    assert "--wheel: found" in str(done.exception)
