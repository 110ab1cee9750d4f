"""The file of machines, hosts.toml: what each is called, where it is reached, how large it is, what it may run."""

from __future__ import annotations

import ipaddress
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from swarm.config.explain import explain
from swarm.config.input_files import FileKind, parse_toml, read_text
from swarm.config.load import check_endpoint, is_loopback
from swarm.config.values import Section
from swarm.errors import ConfigError
from swarm.ranks import HIGHEST_RANK

HostName = Annotated[str, Meta(pattern=r"^[a-z0-9]([a-z0-9-]{0,30}[a-z0-9])?$")]
"""A label of DNS, so that it can be part of a host's name, a unit's and a certificate's."""
HostRole = Literal["router", "keeper", "monitor", "planner", "targets", "agent"]
HOST_ROLES: tuple[HostRole, ...] = ("router", "keeper", "monitor", "planner", "targets", "agent")


class HostConfig(Section, frozen=True, kw_only=True):
    """A machine.

    name     what it is called: small letters, digits and '-'
    address  the name or address under which the other machines reach it
    cores    processor cores that the swarm may use
    roles    roles that may run there; all if not given
    """

    name: HostName
    address: Annotated[str, Meta(pattern=r"^[A-Za-z0-9_.:-]{1,253}$")]
    cores: Annotated[float, Meta(gt=0, le=4096)] = 1.0
    roles: Annotated[tuple[HostRole, ...], Meta(min_length=1)] = HOST_ROLES

    def endpoint(self, port: int) -> str:
        """Where its router is reached, over mutual TLS."""
        host = f"[{self.address}]" if ":" in self.address else self.address
        return f"tls/{host}:{port}"


class HostsConfig(Section, frozen=True, kw_only=True):
    """The machines of a swarm.

    port     on which every router listens
    survive  how many machines may be lost for good, at once: there is one more keeper, and as many standbys of
             planners and of the targets process at least; 1 if not given, 0 where there is one machine
    hosts    the machines
    """

    port: Annotated[int, Meta(ge=1, le=65535)] = 7447
    survive: Annotated[int, Meta(ge=0, le=HIGHEST_RANK)] | None = None
    hosts: Annotated[tuple[HostConfig, ...], Meta(min_length=1, max_length=1000)]

    @property
    def losses(self) -> int:
        """`survive`, or what stands for it."""
        return min(1, len(self.hosts) - 1) if self.survive is None else self.survive


def load_hosts(path: Path) -> HostsConfig:
    """Read and check a file of machines. Raises ConfigError that names the file and the key."""
    return parse_hosts(read_text(path, FileKind.HOSTS), str(path))


def parse_hosts(text: str, source: str = "hosts") -> HostsConfig:
    """As `load_hosts`, of a text."""
    raw = parse_toml(text, source, ConfigError)
    try:
        config = msgspec.convert(raw, HostsConfig)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{source}: {explain(str(error), raw, HostsConfig, 'machines')}") from error
    for fault in _faults(config):
        raise ConfigError(f"{source}: {fault}")
    return config


def _faults(config: HostsConfig) -> Iterator[str]:
    """Where machines that are valid each do not fit together."""
    for key in ("name", "address"):
        found, times = Counter(getattr(host, key) for host in config.hosts).most_common(1)[0]
        if times > 1:
            yield f"hosts: found {times} machines of {key} {found!r}, expected one"
    for n, host in enumerate(config.hosts):
        where = f"hosts[{n}].address"
        if ":" in host.address and not _is_address(host.address):
            yield f"{where}: found {host.address!r}, expected a name or an address; the port is `port`, for all"
        check_endpoint(host.endpoint(config.port), True, where)
        if len(config.hosts) > 1 and is_loopback(host.address):
            yield f"{where}: found {host.address!r}, which is another machine to each; expected an address for all"


def _is_address(text: str) -> bool:
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True
