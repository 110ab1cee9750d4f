"""The secret by which the processes of one user on one machine know each other's words
(docs/design/security.md)."""

from __future__ import annotations

import os
import secrets
import tempfile
from pathlib import Path

from swarm.config.scenario import NetworkConfig
from swarm.errors import ConfigError
from swarm.files import writing
from swarm.wire.access import Authenticator

_SECRET_BYTES = 32
"""Same number of bits as the hash that makes the codes."""


def authenticator_of(network: NetworkConfig, run_id: str) -> Authenticator | None:
    """Returns the object that makes and checks codes of a run; None if certificates identify senders.

    Raises ConfigError where the secret cannot be read or made, or others may read it.
    """
    return None if network.tls is not None else Authenticator(_secret(_path()), run_id)


def state_folder() -> Path:
    """Returns the folder for state of this user's swarms that outlives runs."""
    state = os.environ.get("XDG_STATE_HOME", "")
    base = Path(state) if os.path.isabs(state) else Path.home() / ".local" / "state"
    return base / "terrain-swarm"


def _path() -> Path:
    return state_folder() / "secret"


def _secret(path: Path) -> bytes:
    """The secret in a file, which is made if there is none: by one of several processes that begin at once."""
    with writing(path):
        if not path.exists():
            _make(path)
        if path.stat().st_mode & 0o077:
            raise ConfigError(f"{path}: others may read this secret: chmod 600, or delete it to get a new one")
        secret = path.read_bytes()
    if len(secret) != _SECRET_BYTES:
        raise ConfigError(
            f"{path}: {len(secret)} bytes, where {_SECRET_BYTES} were expected: delete it to get a new one"
        )
    return secret


def _make(path: Path) -> None:
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    handle, draft = tempfile.mkstemp(dir=path.parent)  # readable by this user only
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(secrets.token_bytes(_SECRET_BYTES))
        os.link(draft, path)
    except FileExistsError:
        pass  # another process was first
    finally:
        os.unlink(draft)
