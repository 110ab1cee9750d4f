"""The file of revoked names beside a certificate. Routers and agents read it again and again."""

from __future__ import annotations

from pathlib import Path

import msgspec

from swarm.config.input_files import FileKind, read_text
from swarm.config.scenario import NetworkConfig
from swarm.config.setting_types import CommonName
from swarm.errors import ConfigError
from swarm.files import write_file

FILE = "revoked"


def revoked_in(folder: Path) -> tuple[str, ...]:
    """The names in a folder's file of revoked names, one a line; none where there is no file. Raises ConfigError at
    a line that is no name in a certificate, and where the file cannot be read."""
    path = folder / FILE
    if not path.exists():
        return ()
    lines = read_text(path, FileKind.REVOKED).splitlines()
    names = [(number, line.strip()) for number, line in enumerate(lines, 1)]
    return tuple(_checked(name, f"{path}, line {number}") for number, name in names if name)


def with_revocations(network: NetworkConfig) -> NetworkConfig:
    """The network of a process with the names that its scenario revokes, and those in the file beside its
    certificate."""
    if network.tls is None:
        return network
    found = revoked_in(Path(network.tls.certificate).parent)
    return msgspec.structs.replace(network, revoked=tuple(dict.fromkeys((*network.revoked, *found))))


def revoke(folder: Path, names: list[str]) -> Path:
    """Adds names to a folder's file of revoked names, whole or not at all. Returns its path."""
    path = folder / FILE
    checked = [_checked(name, "a name to revoke") for name in names]
    every = dict.fromkeys((*revoked_in(folder), *checked))
    write_file(path, "".join(f"{name}\n" for name in every).encode())
    return path


def _checked(name: str, where: str) -> str:
    try:
        return msgspec.convert(name, CommonName)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{where}: {name!r} is no name in a certificate, such as agent.all.a0~2") from error
