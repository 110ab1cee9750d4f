"""Certificates: signed by the folder's authority, keys for their owner only, each fault a sentence."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from launch_scripts.deploy.certificates import authority, issue, may_stay
from swarm.errors import ConfigError, StoreError


def test_what_is_there_is_replaced_only_when_asked(tmp_path: Path) -> None:
    path = issue(tmp_path, "a0", [], 30)
    before = path.read_bytes()
    with pytest.raises(StoreError, match=r"a0.pem is there already; --renew replaces it"):
        issue(tmp_path, "a0", [], 30)
    issue(tmp_path, "a0", [], 30, renew=True)
    assert path.read_bytes() != before


@pytest.mark.parametrize(
    ("name", "hosts", "says"),
    [
        ("no/name", [], "name 'no/name' is not 1 to 64 of letters"),
        ("ca", [], "the name ca is the authority's own"),
        ("a0", ["bücher.example"], "host 'bücher.example' is neither an address nor a name in ASCII"),
    ],
)
def test_a_name_that_cannot_be_one_is_refused(tmp_path: Path, name: str, hosts: list[str], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        issue(tmp_path, name, hosts, 30)


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
