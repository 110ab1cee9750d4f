"""A code belongs to one secret, one run, one key, one question and one payload."""

import threading
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm.config.scenario import NetworkConfig, TlsConfig
from swarm.errors import ConfigError, ProtocolError, StoreError
from swarm.runtime.run_secret import authenticator_of
from swarm.wire.access import Authenticator, check_code, code_of
from swarm.wire.topics import POSE, TABLE

SHORT = st.text(max_size=4)
SAID = st.tuples(
    st.binary(min_size=1, max_size=32), SHORT, SHORT, st.binary(min_size=1, max_size=8), st.binary(max_size=8)
)
"""Secret, run, key, payload, question."""


@given(SAID, SAID)
def test_a_code_is_good_for_what_it_was_made_for_and_nothing_else(one, other) -> None:
    secret, run, key, payload, asked = one
    code = Authenticator(secret, run).code(key, payload, asked)
    check_code(Authenticator(secret, run), code, TABLE, "put", key, payload, asked)
    secret, run, key, payload, asked = other
    if one != other:
        with pytest.raises(ProtocolError, match="a false code"):
            check_code(Authenticator(secret, run), code, TABLE, "put", key, payload, asked)


def test_figures_of_a_router_count_in_each_run_of_its_user_and_nothing_else_does() -> None:
    router, member = Authenticator(b"secret", ""), Authenticator(b"secret", "run")
    assert router.code("stats/router/0", b"figures") == member.code("stats/router/0", b"figures")
    for key in ("stats/keeper/0", "left/router/a0", "target/router/pose"):
        assert router.code(key, b"said") != member.code(key, b"said")


def test_no_code_is_no_good_but_for_what_a_topic_leaves_free() -> None:
    ours = Authenticator(b"secret", "run")
    with pytest.raises(ProtocolError, match="no code"):
        check_code(ours, None, TABLE, "put", "key", b"payload")
    with pytest.raises(ProtocolError, match="in a payload"):
        check_code(ours, None, TABLE, "ask", "key", b"")
    check_code(ours, None, POSE, "put", "key", b"payload")
    check_code(None, None, TABLE, "put", "key", b"payload")
    assert code_of(None, "key", b"payload") is None


@pytest.fixture
def secret(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    return tmp_path / "terrain-swarm" / "secret"


def test_processes_that_begin_at_once_share_one_secret_that_no_one_else_may_read(secret: Path) -> None:
    made: list[bytes] = []

    def begin() -> None:
        authenticator = authenticator_of(NetworkConfig(), "run")
        made.append(authenticator.code("key", b"payload"))

    threads = [threading.Thread(target=begin) for _ in range(16)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(made) == 16
    assert len(set(made)) == 1
    assert [file.name for file in secret.parent.iterdir()] == ["secret"]
    assert secret.stat().st_mode & 0o077 == 0


def test_a_secret_that_others_may_read_or_that_is_cut_is_refused_by_name(secret: Path) -> None:
    authenticator_of(NetworkConfig(), "run")
    secret.chmod(0o644)
    with pytest.raises(ConfigError, match=f"{secret}.*chmod 600"):
        authenticator_of(NetworkConfig(), "run")
    secret.chmod(0o600)
    secret.write_bytes(b"short")
    with pytest.raises(ConfigError, match=f"{secret}: 5 bytes, where 32"):
        authenticator_of(NetworkConfig(), "run")


def test_a_file_in_the_place_of_the_folder_is_named(secret: Path) -> None:
    secret.parent.write_text("")
    with pytest.raises(StoreError, match=f"cannot write {secret}"):
        authenticator_of(NetworkConfig(), "run")


def test_with_certificates_there_is_no_secret(secret: Path) -> None:
    network = NetworkConfig(tls=TlsConfig(ca="ca.pem", certificate="a0.pem", key="a0.key"))
    assert authenticator_of(network, "run") is None
    assert not secret.exists()
