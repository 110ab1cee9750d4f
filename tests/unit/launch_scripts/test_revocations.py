"""The file of revoked names: the list in force after it changed, is broken or was deleted."""

from __future__ import annotations

from pathlib import Path

import pytest

from launch_scripts.deploy.revocations import FILE, revoke, revoked_in, with_revocations
from swarm.config.scenario import NetworkConfig, TlsConfig
from swarm.errors import ConfigError, StoreError


def network(folder: Path) -> NetworkConfig:
    tls = TlsConfig(ca=str(folder / "ca.pem"), certificate=str(folder / "router.0.pem"), key=str(folder / "k"))
    return NetworkConfig(tls=tls, revoked=("agent.all.a9",))


def test_names_are_added_once_and_in_order_and_a_router_denies_them_beside_those_of_its_scenario(
    tmp_path: Path,
) -> None:
    assert with_revocations(network(tmp_path)) == network(tmp_path)
    revoke(tmp_path, ["agent.all.a1", "agent.all.a0~2"])
    revoke(tmp_path, ["agent.all.a1", "keeper.0", "agent.all.a9"])
    assert revoked_in(tmp_path) == ("agent.all.a1", "agent.all.a0~2", "keeper.0", "agent.all.a9")
    assert with_revocations(network(tmp_path)).revoked == (
        "agent.all.a9", "agent.all.a1", "agent.all.a0~2", "keeper.0",
    )  # fmt: skip
    assert with_revocations(NetworkConfig()) == NetworkConfig()


def test_blank_lines_say_nothing_and_a_line_that_is_no_name_is_named(tmp_path: Path) -> None:
    (tmp_path / FILE).write_text("agent.all.a1\r\n\n  keeper.0  \n")
    assert revoked_in(tmp_path) == ("agent.all.a1", "keeper.0")
    (tmp_path / FILE).write_text("agent.all.a1\nkeeper 0\n")
    with pytest.raises(ConfigError, match=r"revoked, line 2: 'keeper 0' is no name in a certificate"):
        revoked_in(tmp_path)


@pytest.mark.parametrize("content", [b"\xff\xfe", b"agent.all.a1\n" * 100_000])
def test_a_file_that_is_no_list_of_names_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / FILE).write_bytes(content)
    with pytest.raises(ConfigError, match="revoked"):
        with_revocations(network(tmp_path))


def test_what_cannot_be_read_or_written_is_an_error_that_names_it_and_a_wrong_name_changes_nothing(
    tmp_path: Path,
) -> None:
    revoke(tmp_path, ["keeper.0"])
    with pytest.raises(ConfigError, match=r"'a b' is no name in a certificate, such as agent\.all\.a0~2$"):
        revoke(tmp_path, ["keeper.1", "a b"])
    assert revoked_in(tmp_path) == ("keeper.0",)
    with pytest.raises(StoreError, match="cannot write"):
        revoke(tmp_path / "nowhere", ["keeper.0"])
    (tmp_path / "folder" / FILE).mkdir(parents=True)
    with pytest.raises(ConfigError, match="cannot read"):
        revoked_in(tmp_path / "folder")
