"""The file of machines, hosts.toml: what each is called, where it is reached, how large it is, what it may run."""

from __future__ import annotations

import ipaddress
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal, get_args

from msgspec import Meta

from swarm.config.explain import converted
from swarm.config.input_files import FileKind, parse_toml, read_text
from swarm.config.load import check_endpoint, is_loopback
from swarm.config.setting_types import Section
from swarm.errors import ConfigError
from swarm.peers import HIGHEST_RANK

HostName = Annotated[
    str,
    Meta(
        pattern=r"^[a-z0-9]([a-z0-9-]{0,30}[a-z0-9])?\Z", description="of 32 small letters, digits and '-' at most"
    ),
]
"""A label of DNS, so that it can be part of a host's name, a unit's and a certificate's."""
HostRole = Literal["router", "keeper", "monitor", "planner", "places", "targets", "agent"]
_LABEL = re.compile(r"[A-Za-z0-9_]([A-Za-z0-9_-]{0,61}[A-Za-z0-9_])?")
HOST_ROLES: tuple[HostRole, ...] = get_args(HostRole)


class HostConfig(Section, frozen=True, kw_only=True):
    """A machine.

    name     what it is called: small letters, digits and '-'
    address  the name or address under which the other machines reach it
    cores    processor cores that the swarm may use
    roles    roles that may run there; all if not given
    """

    name: HostName
    address: Annotated[str, Meta(pattern=r"^[A-Za-z0-9_.:-]{1,253}\Z", description="a name or an address")]
    cores: Annotated[float, Meta(ge=0.01, le=4096)] = 1.0
    roles: Annotated[tuple[HostRole, ...], Meta(min_length=1)] = HOST_ROLES

    def endpoint(self, port: int) -> str:
        """Endpoint of its router, over mutual TLS."""
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
        """`survive`, or its default."""
        return min(1, len(self.hosts) - 1) if self.survive is None else self.survive


def load_hosts(path: Path) -> HostsConfig:
    """Reads and checks a file of machines. Raises ConfigError that names the file and the key."""
    return parse_hosts(read_text(path, FileKind.HOSTS), str(path))


def parse_hosts(text: str, source: str = "hosts") -> HostsConfig:
    """Like `load_hosts`, from a text."""
    config = converted(parse_toml(text, source, ConfigError), HostsConfig, source, "machines")
    for fault in _faults(config):
        raise ConfigError(f"{source}: {fault}")
    return config


def _faults(config: HostsConfig) -> Iterator[str]:
    """Returns contradictions between machines that are valid each."""
    for key, of in (("name", lambda host: host.name), ("address", lambda host: _plain(host.address))):
        found, times = Counter(map(of, config.hosts)).most_common(1)[0]
        if times > 1:
            yield f"hosts: found {times} machines of {key} {found!r}, expected one"
    for n, host in enumerate(config.hosts):
        where = f"hosts[{n}].address"
        if ":" in host.address and _ip(host.address) is None:
            yield f"{where}: found {host.address!r}, expected a name or an address; the port is `port`, for all"
        if not _can_be_reached(host.address):
            yield f"{where}: found {host.address!r}, expected a name or an address under which others reach it"
        check_endpoint(host.endpoint(config.port), True, where)
        if len(config.hosts) > 1 and is_loopback(host.address):
            yield f"{where}: found {host.address!r}, which to each machine is itself; expected one for all"
        if len(set(host.roles)) < len(host.roles):
            yield f"hosts[{n}].roles: found a role twice, expected each once"


def _can_be_reached(address: str) -> bool:
    """Returns True if it is one machine's address, or a possible name of DNS: its last label is not a number."""
    ip = _ip(address)
    if ip is None:
        labels = address.split(".")
        return all(map(_LABEL.fullmatch, labels)) and not labels[-1].isdigit()
    return not (ip.is_unspecified or ip.is_multicast or str(ip) == "255.255.255.255")


def _plain(address: str) -> str:
    """An address as all of its spellings are."""
    return str(_ip(address) or address.lower())


def _ip(text: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(text)
    except ValueError:
        return None
