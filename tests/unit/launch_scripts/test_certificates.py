"""Certificates: signed by the folder's authority, keys for their owner only, each fault a sentence."""

import os
import stat
from pathlib import Path

import pytest

from launch_scripts.deploy.certificates import authority, issue, may_stay
from swarm.config.revocations import FILE, revoke, revoked_in, with_revocations
from swarm.config.scenario import NetworkConfig, TlsConfig
from swarm.errors import ConfigError, StoreError


def test_what_is_there_is_replaced_only_when_asked(tmp_path: Path) -> None:
    path = issue(tmp_path, "a0", [], 30)
    before = path.read_bytes()
    with pytest.raises(StoreError, match=r"a0.pem is there already; --renew replaces it"):
        issue(tmp_path, "a0", [], 30)
    issue(tmp_path, "a0", [], 30, renew=True)
    assert path.read_bytes() != before


def test_a_damaged_authority_is_told_of(tmp_path: Path) -> None:
    issue(tmp_path, "a0", [], 30)
    (tmp_path / "ca.key").write_bytes((tmp_path / "a0.key").read_bytes())
    with pytest.raises(StoreError, match=r"ca.key is not the key of"):
        issue(tmp_path, "a1", [], 30)
    (tmp_path / "ca.key").write_text("nothing")
    with pytest.raises(StoreError, match="are not certificates and a key in PEM"):
        issue(tmp_path, "a1", [], 30)
    (tmp_path / "ca.key").unlink()
    with pytest.raises(StoreError, match=r"ca\.key: No such file"):
        issue(tmp_path, "a1", [], 30)


@pytest.mark.parametrize(
    "host", ["fd00:0:0:0::1", "FD00::1", "fd00:0000:0000:0000:0000:0000:0000:0001", "::ffff:10.0.0.1", "Base.local"]
)
def test_a_host_is_the_same_however_it_is_written(tmp_path: Path, host: str) -> None:
    path = issue(tmp_path, "router.0", [host, "127.0.0.1"], 30)
    assert may_stay(path, [host], "router.0")
    assert not may_stay(path, [host, "fd00::2"], "router.0")
    assert not may_stay(path, [host], "router.0~2")


def test_what_does_not_go_together_may_not_stay(tmp_path: Path) -> None:
    """The state after an interrupted renewal or with another authority."""
    path, other = issue(tmp_path, "a0", [], 30), issue(tmp_path, "a1", [], 30)
    path.with_suffix(".key").write_bytes(other.with_suffix(".key").read_bytes())
    assert not may_stay(path, [], "a0")
    other.with_suffix(".key").unlink()
    assert not may_stay(other, [], "a1")
    path = issue(tmp_path, "a0", [], 30, renew=True)
    path.write_bytes(path.read_bytes()[:99])
    assert not may_stay(path, [], "a0")
    path = issue(tmp_path, "a0", [], 30, renew=True)
    for file in ("ca.pem", "ca.key"):
        (tmp_path / file).unlink()
    authority(tmp_path)
    assert not may_stay(path, [], "a0")


@pytest.mark.parametrize("name", ["ca", "a0"])
def test_a_key_is_for_its_owner_only_whatever_was_left(tmp_path: Path, name: str) -> None:
    left = tmp_path / f"{name}.{os.getpid()}.part.key"
    left.write_text("")
    left.chmod(0o666)
    with left.open() as reader:
        issue(tmp_path, "a0", [], 30)
        assert os.fstat(reader.fileno()).st_size == 0
    assert stat.S_IMODE((tmp_path / f"{name}.key").stat().st_mode) == 0o600
    assert not left.exists()


# --- the file of revoked names: the list in force after it changed, is broken or was deleted ---------------------


def network(folder: Path) -> NetworkConfig:
    tls = TlsConfig(ca=str(folder / "ca.pem"), certificate=str(folder / "router.0.pem"), key=str(folder / "k"))
    return NetworkConfig(tls=tls, revoked=("agent.all.a9",))


def test_names_are_added_once_in_order_and_a_router_denies_them_and_those_of_its_scenario(tmp_path: Path) -> None:
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


def test_what_cannot_be_read_or_written_is_named_and_a_wrong_name_changes_nothing(tmp_path: Path) -> None:
    revoke(tmp_path, ["keeper.0"])
    with pytest.raises(ConfigError, match=r"'a b' is no name in a certificate, such as agent\.all\.a0~2$"):
        revoke(tmp_path, ["keeper.1", "a b"])
    assert revoked_in(tmp_path) == ("keeper.0",)
    with pytest.raises(StoreError, match="cannot write"):
        revoke(tmp_path / "nowhere", ["keeper.0"])
    (tmp_path / "folder" / FILE).mkdir(parents=True)
    with pytest.raises(ConfigError, match="cannot read"):
        revoked_in(tmp_path / "folder")
