"""Options of a run: a scenario by name, options of the command line, processes, folder."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import secrets
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from launch_scripts import process_table
from launch_scripts.launcher.log_file import LogFormat
from launch_scripts.observe.run_folders import LAST
from launch_scripts.ports import free_ports
from launch_scripts.web import LOOPBACK
from shared_map.importers.terrain_sources import FILE_KINDS, is_terrain
from swarm.clock import date_ns
from swarm.config.explain import choice, converted, nearest
from swarm.config.ground import CostConfig, TerrainConfig
from swarm.config.input_files import FileKind, check_bytes, quoted
from swarm.config.scenario import MonitorConfig, NetworkConfig, Scenario, TlsConfig
from swarm.config.scenario_files import load_scenario
from swarm.endpoints import check_endpoint
from swarm.errors import ConfigError, StoreError
from swarm.files import check_writable, make_folder, writing
from swarm.journal import digest_of
from swarm.peers import split_rank

SCENARIOS = Path(__file__).parents[1] / "scenarios"


def find_scenario(name: str, preset: str | None = None, crs: str | None = None) -> Scenario:
    """Loads a built-in scenario by name, or one from a file. A file of elevation stands for a scenario on it that
    says nothing else, but the preset of its cost and its coordinate system."""
    path = Path(name)
    if os.path.isfile(name) and is_terrain(path):
        ground = TerrainConfig(source=name, crs=crs)
        return Scenario(name=path.stem, terrain=ground, cost=CostConfig(preset=preset))  # type: ignore[arg-type]  # which it checks
    for option, given, key in (("--preset", preset, "cost.preset"), ("--crs", crs, "terrain.crs")):
        if given is not None:
            raise ConfigError(f"{option} goes with a terrain file: in the scenario {name} set {key}")
    return load_scenario(scenario_path(name))


def scenario_path(name: str) -> Path:
    """The file of a built-in scenario, or the one named. Raises ConfigError where there is none."""
    path = Path(name)
    # These say no of a name that no file can have. A device or a pipe is refused by its reader.
    if os.path.exists(name) and not os.path.isdir(name):
        return path
    built_in = SCENARIOS / f"{name}.toml"
    if "/" not in name and os.path.isfile(built_in):
        return built_in
    if os.path.isdir(name):
        within = sorted(each.name for each in path.glob("*.toml"))[:5]
        hint = f"; in it are {', '.join(within)}" if within else ""
        raise ConfigError(f"no scenario {name!r}: it is a folder, expected a .toml file{hint}")
    names = sorted(file.stem for file in SCENARIOS.glob("*.toml"))
    if path.suffix == ".toml":
        raise ConfigError(
            f"cannot read scenario {path.absolute()}: No such file; `swarm new {name}` writes one, built in are"
            f" {', '.join(names)}"
        )
    if path.suffix in FILE_KINDS.split(", "):
        files = [each.name for each in path.parent.glob("*")]
        raise ConfigError(
            f"no terrain {name!r}: no such file in {path.parent.absolute()}{nearest(path.name, files)}"
        )
    raise ConfigError(f"no scenario {quoted(name)}{choice(name, names, ' give a .toml file or one of: ')}")


def with_options(
    network: NetworkConfig,
    *,
    connect: str | None = None,
    listen: str | None = None,
    also_listen: str | None = None,
    namespace: str | None = None,
    tls: TlsConfig | None = None,
) -> NetworkConfig:
    """A network with what the options of a command change. Raises ConfigError where endpoints would leave the
    machine unencrypted.

    also_listen  an endpoint of the router beside those that it has
    """
    tls = tls or network.tls
    changes: dict[str, object] = {"tls": tls}
    given = (("connect", connect, ()), ("listen", listen, ()), ("listen", also_listen, network.listen))
    for key, endpoint, beside in given:
        if endpoint is not None:
            check_endpoint(endpoint, tls is not None, f"--{key}")
            changes[key] = (*beside, endpoint)
    if namespace is not None:
        changes["namespace"] = namespace
    raw = {**msgspec.to_builtins(network), **msgspec.to_builtins(changes)}
    return converted(raw, NetworkConfig, "network")


def as_process(scenario: Scenario, role: str, id: str) -> Scenario:
    """The scenario as one process needs it: with its own certificate, where `network.tls` names a folder of them.
    Raises ConfigError where the folder has none for it."""
    tls = own_certificate(scenario.network.tls, process_table.certificate_name(scenario, role, id))
    return msgspec.structs.replace(scenario, network=msgspec.structs.replace(scenario.network, tls=tls))


def own_certificate(tls: TlsConfig | None, name: str) -> TlsConfig | None:
    """`tls` with the files of a name in place of folders. Raises ConfigError where there are none."""
    if tls is None:
        return None
    files = []
    for file, suffix in ((Path(tls.certificate), "pem"), (Path(tls.key), "key")):
        own = file / f"{name}.{suffix}" if file.is_dir() else file
        if not own.is_file():
            raise ConfigError(f"no file {own}, which {name} needs: `swarm deploy certs` makes it")
        check_bytes(own, FileKind.CERTIFICATE)
        files.append(str(own))
    return TlsConfig(ca=tls.ca, certificate=files[0], key=files[1])


def with_port(scenario: Scenario, port: int) -> Scenario:
    """Router on `port`, live view on the next; 0 picks two free ones."""
    ports = free_ports(2) if port == 0 else [port, port + 1]
    if ports[-1] > 65535:
        raise ConfigError(f"--port {port}: the live view takes the port after it, so at most 65534")
    endpoint = f"tcp/127.0.0.1:{ports[0]}"
    network = msgspec.structs.replace(scenario.network, listen=(endpoint,), connect=(endpoint,))
    monitor = msgspec.structs.replace(scenario.monitor, web_port=ports[1])
    return msgspec.structs.replace(scenario, network=network, monitor=monitor)


def new_run_id() -> str:
    """Id of a new run: the time, and four hexadecimal digits."""
    return f"{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(2)}"


_HIGHEST = (1 << 62) - 2
"""Highest incarnation that is read from a file: a token may say less than 2^62, and the next one is one more."""
_DIGITS = 20
"""Width of the number in a file of incarnations, which never changes."""


def common_run_id(scenario: Scenario) -> str:
    """Run id derived from the scenario, so that separately started parts agree on it."""
    same = msgspec.structs.replace(
        scenario, network=NetworkConfig(), monitor=MonitorConfig(), seconds=Scenario().seconds
    )
    settings = msgspec.to_builtins(same, order="deterministic")
    digest = hashlib.blake2b(msgspec.json.encode(settings), digest_size=4).hexdigest()
    return f"{scenario.name}-{digest}"


def make_run_dir(runs: Path, run_id: str) -> Path:
    """Returns the folder of a run on this machine: files of the run, such as a keeper's store, are found there when
    its processes restart. Raises ConfigError on an id that no folder may have, StoreError where the folder cannot
    be made."""
    process_table.check_name("run id", run_id)
    if run_id in (".", "..", LAST):
        raise ConfigError(f"run id {run_id!r} would name another folder than a new one in {runs}; choose another")
    run_dir = runs / run_id
    try:
        if not run_dir.exists():  # a restart works on a full disk
            check_writable(next(filter(Path.is_dir, (runs, *runs.absolute().parents))), file=run_dir)
        make_folder(run_dir)
    except StoreError as error:
        raise StoreError(f"{error}; --runs names another folder for runs") from error
    return run_dir.resolve()


def next_incarnation(run_dir: Path, role: str, id: str) -> int:
    """The incarnation of a process that starts now: nanoseconds since 1970, and in any case higher than that of
    every earlier start in this run's folder. Raises StoreError if the folder cannot be written.

    A restart is therefore the later one even if the clock was set back meanwhile.
    """
    path = run_dir / "lives" / f"{role}-{id}"
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        file = os.open(path, os.O_CREAT | os.O_RDWR, 0o644)
        try:
            fcntl.flock(file, fcntl.LOCK_EX)  # of two that start at once each gets a number of its own
            last = 0
            digits, _, digest = os.pread(file, 3 * _DIGITS, 0).partition(b" ")
            # Without a digest it is from before there were any. A changed file is made again from the clock.
            if len(digits) == _DIGITS and digits.isdigit() and digest in (b"", _hex_digest(digits)):
                last = min(int(digits), _HIGHEST)
            incarnation = max(date_ns(), last + 1)
            # Fixed-length write in place, so that a restart works on a full disk.
            digits = b"%0*d" % (_DIGITS, incarnation)
            content = digits + b" " + _hex_digest(digits)
            if os.pwrite(file, content, 0) != len(content):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            os.fsync(file)
        finally:
            os.close(file)
    return incarnation


def _hex_digest(content: bytes) -> bytes:
    return digest_of(content).hex().encode()


@dataclass(frozen=True, slots=True)
class UpOptions:
    """Options of a run.

    table            the processes to start here, in order of start
    joins            there is a router elsewhere: none is started here
    run_id           the run to take part in; if None it is made or found
    began_s          time.monotonic() at which the command was given
    metrics_port     where figures are served to Prometheus, and health to probes; 0 is any
    signals_address  of this machine, on which that port is opened
    log_format       of all logs of this machine
    record_inputs    of every process, for `swarm runs replay`
    takes_over       from the launcher that runs this part of the run here
    stays_watched    goes on beyond the scenario's seconds while a viewer is connected
    """

    scenario: Scenario
    runs: Path
    table: tuple[process_table.ProcessSpec, ...]
    joins: bool = False
    run_id: str | None = None
    as_json: bool = False
    plain: bool = False
    began_s: float = field(default_factory=time.monotonic)
    record_inputs: bool = False
    metrics_port: int | None = None
    takes_over: bool = False
    stays_watched: bool = False
    signals_address: str = LOOPBACK
    log_format: LogFormat = "text"

    @property
    def roles(self) -> tuple[str, ...]:
        """Those of the processes that are started here."""
        return tuple(dict.fromkeys(spec.role for spec in self.table))

    @property
    def is_new(self) -> bool:
        """True if the run begins here, with all of its processes."""
        return not self.joins and self.is_whole and self.run_id is None and not self.takes_over

    @property
    def is_whole(self) -> bool:
        """True if only a router may be missing."""
        return set(process_table.processes_of(self.scenario, process_table.ROLES[1:])) <= set(self.table)

    @property
    def records(self) -> bool:
        """True if this launcher is the one of the run that records and reports it."""
        return any(spec.name == process_table.RECORDED_BESIDE for spec in self.table)

    @property
    def asks_for_ground(self) -> bool:
        """True if files of the terrain may be missing here, as a keeper elsewhere serves the base map."""
        return self.joins or not (self.is_whole or "keeper" in self.roles)

    @property
    def ranks_of_added(self) -> list[int]:
        """Returns the ranks of the planners that are started here for a target which is added during the run: the
        same ranks as of the scenario's first target. Each planner then starts once, and standbys elsewhere."""
        ids = [split_rank(spec.id) for spec in self.table if spec.role == "planner"]
        return [rank for target, rank in ids if target == self.scenario.target_ids[0]]


def chosen_processes(
    scenario: Scenario, words: Sequence[str], rank: int | None, *, joins: bool = False
) -> tuple[process_table.ProcessSpec, ...]:
    """The processes that `--only` names, in order of start: of a role, or `ROLE.ID` alone. Routers and keepers may
    have any id, as there may be more of them than in the scenario. Raises ConfigError where there is none.

    rank   of planners and the targets process, only those of this rank; if None all
    joins  there is a router elsewhere: none is among them
    """
    chosen: dict[str, process_table.ProcessSpec] = {}
    for word in words:
        role, _, id = word.partition(".")
        if role not in process_table.ROLES:
            raise ConfigError(f"--only: no role {role!r}{choice(role, process_table.ROLES, ' the roles are ')}")
        if joins and role == "router":
            continue
        every = process_table.processes_of(scenario, (role,), rank)
        if id:
            ids = [spec.id for spec in process_table.processes_of(scenario, (role,))]
            if id not in ids and not process_table.TABLE[role].any_id:
                raise ConfigError(f"--only: no {role} {id!r} in scenario {scenario.name}; it has {', '.join(ids)}")
            process_table.check_name("--only", id)
            every = [process_table.ProcessSpec(role, id)]
        chosen |= {spec.name: spec for spec in every}
    if not chosen:
        end = "to start here" if rank is None else f"of rank {rank} to start; see standbys"
        raise ConfigError(f"scenario {scenario.name} has no {' or '.join(words)} {end}")
    return tuple(sorted(chosen.values(), key=lambda spec: process_table.ROLES.index(spec.role)))
