"""One archive for each machine of a plan: its scenario, its certificates and no others, its files, its service.

The service is a systemd service, or a compose file, from the templates beside this file. systemd starts one
launcher, which restarts a crashed process within a fraction of a second from a warm fork server, builds the terrain
once for all, and ends roles in order. The unit limits all of it, and separates it from the rest
of the system. In containers (compose-spec.io, which docker compose and podman-compose read) each process is a
service of its own, which the engine starts again. zenohd, Eclipse's router, can stand for a router of ours.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import io
import json
import math
import os
import re
import shlex
import sys
import tarfile
import time
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import msgspec

from launch_scripts.deploy.certificates import CA, THIS_MACHINE, authority, issue, may_stay, private_file
from launch_scripts.deploy.machine_plan import (
    KEEPER,
    ROUTER,
    Plan,
    PlannedHost,
    PlannedProcess,
    as_json,
    router_name,
)
from launch_scripts.process_table import OPERATOR, TABLE
from swarm.bus.zenoh_config import access_control, common_name, low_pass_filter, tls_settings
from swarm.config.input_files import FileKind, read_bytes
from swarm.config.plugin_names import plugins_of
from swarm.config.revocations import FILE as REVOKED
from swarm.config.revocations import revoked_in
from swarm.config.scenario import UNTIL_STOPPED_S, NetworkConfig, Scenario, TlsConfig
from swarm.config.scenario_files import scenario_text, with_files
from swarm.errors import ConfigError, StoreError
from swarm.files import write_file, writing
from swarm.wire.codec import MAX_PAYLOAD_BYTES
from swarm.wire.topics import MARKS

UNIT, COMPOSE_FILE = "swarm.service", "compose.yaml"
HEALTH_PORT = 9464
"""Port where a launcher, or a container, answers probes and Prometheus."""
_LABEL = re.compile(r"[a-z0-9]+([.-][a-z0-9]+)*")
_LONGEST_LABEL = 50
"""A label has 63 characters at most (RFC 1123). The other 13 characters are left for suffixes: Compose adds a
number, Kubernetes up to 11 characters."""
_SCENARIO = "scenario.toml"


@cache
def _templates() -> Any:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    # They make scripts and YAML, not HTML: a value is quoted unless it is a checked name.
    loader = PackageLoader("launch_scripts.deploy")
    return Environment(loader=loader, undefined=StrictUndefined, keep_trailing_newline=True, autoescape=False)


def _rendered(template: str, **values: Any) -> str:
    text: str = _templates().get_template(f"{template}.j2").render(values)
    return text


def up_arguments(plan: Plan, host: PlannedHost, scenario: str) -> list[str]:
    """The words after `swarm` that start a machine's processes, without --runs."""
    only = [word for process in host.processes for word in ("--only", process.selector)]
    return ["up", scenario, "--run-id", plan.run_id, "--plain", "--metrics-port", str(HEALTH_PORT), *only]


def systemd_files(plan: Plan, host: PlannedHost) -> dict[str, str]:
    """Name -> text: the unit, the script that installs it, and the one that runs without it. Scripts are those
    without an ending."""
    return {
        UNIT: _rendered(
            UNIT,
            plan=plan,
            host=host,
            roles=", ".join(dict.fromkeys(process.role for process in host.processes)),
            arguments=" ".join(up_arguments(plan, host, f"/etc/swarm/{_SCENARIO}")),
            cpu_percent=math.ceil(100 * host.cores),
        ),
        "install": _rendered("install_systemd.sh", host=host),
        "run": _rendered("run.sh", arguments=shlex.join(up_arguments(plan, host, _SCENARIO))),
    }


class Container(NamedTuple):
    """A process of a plan, as a service of a compose file.

    name   a label of DNS that no other process of the plan has: "planner-t3--r1"
    words  the words after `swarm` that run it
    """

    process: PlannedProcess
    name: str
    image: str
    words: list[str]


def containers_of(plan: Plan, host: PlannedHost, image: str = "") -> list[Container]:
    """One for each process of a machine, in its order. `image`: of the roles; if empty, that of this version. A
    monitor needs a larger one."""
    version = importlib.metadata.version("terrain-swarm").partition("+")[0]  # a tag has no "+COMMIT"
    base = image or f"terrain-swarm:{version}"
    asked = ["--health-port", str(HEALTH_PORT), "--signals-address", "127.0.0.1", "--log-format", "json"]
    found = []
    for process in host.processes:
        run = () if process.role == ROUTER else ("--run-id", plan.run_id)
        words = ["role", process.role, f"/etc/swarm/{_SCENARIO}", "--id", process.id, *run]
        words += ["--runs", "/var/lib/swarm/runs", *asked]
        tag = "-all" if process.role == "monitor" else ""
        found.append(Container(process, dns_label(process.name), base + tag, words))
    return found


def compose_files(plan: Plan, host: PlannedHost, image: str = "", revoked: Sequence[str] = ()) -> dict[str, str]:
    """Name -> text: the compose file of a machine, its scenario as containers read it, the script that starts them.

    image    of the roles; if empty, that of this version
    revoked  names in certificates that its router denies everything, beside those of the scenario
    """
    scenario, ground = host_scenario(plan, host)
    containers = containers_of(plan, host, image)
    compose = _rendered(
        COMPOSE_FILE,
        plan=plan,
        host=host,
        # One name for the machine and the run: the same folder may be unpacked anywhere.
        name=dns_label(f"swarm-{plan.run_id}-{host.name}"),
        containers=containers,
        mounted=[_SCENARIO, *([PLUGINS] if plugin_files(plan.scenario) else []), *([GROUND] if ground else [])],
        table=TABLE,
        router=router_name(host),
        routers=[each.name for each in containers if each.process.role == ROUTER],
    )
    inside = scenario_text(_contained(scenario, plan, host, revoked), Path())
    return {COMPOSE_FILE: compose, _SCENARIO: inside, "install": _rendered("install_compose.sh")}


def _contained(scenario: Scenario, plan: Plan, host: PlannedHost, revoked: Sequence[str]) -> Scenario:
    """The scenario of a machine for its containers, each of which has addresses of its own."""
    beside = {f"tls/127.0.0.1:{plan.port}": f"tls/{router_name(host)}:{plan.port}"} if host.listen else {}
    network = msgspec.structs.replace(
        scenario.network,
        connect=tuple(beside.get(each, each) for each in scenario.network.connect),
        revoked=tuple(dict.fromkeys((*scenario.network.revoked, *revoked))),
    )
    # A live view listens on loopback, which is the container's own.
    unseen = msgspec.structs.replace(scenario.monitor, live=False)
    return msgspec.structs.replace(scenario, network=network, monitor=unseen)


def dns_label(text: str) -> str:
    """Returns a DNS label (RFC 1123) for a text, different for each text."""
    if _LABEL.fullmatch(text) and len(label := text.replace(".", "--")) <= _LONGEST_LABEL:
        return label
    number = hashlib.blake2b(text.encode(), digest_size=4).hexdigest()
    plain = re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")[: _LONGEST_LABEL - len(number) - 1]
    return f"{plain.strip('-')}-{number}".lstrip("-")


def zenohd_config(network: NetworkConfig, plugins: str | None = None) -> dict[str, Any]:
    """The configuration that `zenohd -c FILE` reads, as JSON.

    plugins  folder of `libzenoh_plugin_storage_manager.so`; without one marks are passed on, not stored
    With certificates the names in `network.admit` may take part, under the rules of `swarm role router`. Raises
    ConfigError on one that no process can have.
    """
    text = _rendered(
        "zenohd.json",
        network=msgspec.to_builtins(network),
        lease_ms=int(network.lease_s * 1000),
        most_bytes=MAX_PAYLOAD_BYTES + (1 << 16),
        plugins=plugins,
        storage={"key_expr": MARKS.expression(network.namespace), "volume": "memory"},
        tls=network.tls and tls_settings(network.tls),
        access_control=network.tls and access_control(network.namespace, network.admit, network.revoked),
        low_pass_filter=low_pass_filter(network.namespace),
    )
    config: dict[str, Any] = json.loads(text)
    return config


KitName = Literal["systemd", "compose"]
"""Manager of a machine's processes: systemd, whose service is the launcher, or a container engine."""
GROUND, CERTIFICATES, PLUGINS = "ground", "certs", "plugins"
"""Folders beside a machine's scenario."""
_BESIDE = (".dbf", ".shx", ".prj", ".cpg", ".hdr", ".tfw", ".pgw", ".wld", ".blw", ".aux.xml", ".msk")
"""Endings of files that a format keeps beside its main one."""
_NAMES_OTHERS = (".vrt", ".yaml", ".yml")
PLAN = "plan.json"
CONTENTS = "contents"
"""The file that names all others of an archive, a line each."""


class _Before(msgspec.Struct):
    """Content of an earlier plan."""

    run_id: str = ""
    hosts: tuple[PlannedHost, ...] = ()


def write_kits(
    plan: Plan, out: Path, days: int, kit: KitName = "systemd", *, image: str = "", wheel: Path | None = None
) -> list[Path]:
    """An archive for each machine, `out/NAME.tar.gz`, which unpacks into `swarm-NAME/`. Returns the archives.

    Certificates lie in `out/certs` with the authority's key, which leaves it for no archive. Existing files are
    kept while they are valid, so that a second plan replaces no key without need. Raises StoreError where a file
    cannot be read or written.

    image  of containers, see `compose_files`
    wheel  file from which the swarm is installed
    """
    folder = out / CERTIFICATES
    revoked = revoked_in(folder)
    authority(folder)

    def issued(name: str, place: str, hosts: tuple[str, ...] = ()) -> dict[str, Path]:
        """A certificate and its key, at the place where a process looks for them: those that are there, or new ones
        if they have to be others or end soon."""
        path, called = folder / f"{name}.pem", common_name(name, revoked)
        if not may_stay(path, hosts, called):
            issue(folder, name, hosts, days, renew=True, called=called)
        return {f"{CERTIFICATES}/{place}{suffix}": path.with_suffix(suffix) for suffix in (".pem", ".key")}

    issued(OPERATOR, OPERATOR)
    written = []
    for host in plan.hosts:
        scenario, ground = host_scenario(plan, host)
        texts = {"scenario.toml": scenario_text(scenario, Path()), PLAN: as_json(plan)}
        if revoked and host.of(ROUTER):
            texts[f"{CERTIFICATES}/{REVOKED}"] = "".join(f"{name}\n" for name in revoked)
        files = {**ground, **plugin_files(plan.scenario), f"{CERTIFICATES}/{CA}.pem": folder / f"{CA}.pem"}
        for process in host.processes:
            reached = (host.address, router_name(host), *THIS_MACHINE) if process.role == ROUTER else ()
            files |= issued(process.certificate, process.certificate, reached)
        if kit == "systemd":
            texts |= systemd_files(plan, host)
            files |= issued(host.operator, OPERATOR)
        else:
            texts |= compose_files(plan, host, image, revoked)
        if wheel is not None:
            files[f"wheels/{wheel.name}"] = wheel
        written.append(_archive(out, host.name, texts, files))
    keep_plan(plan, out)
    return written


def keep_plan(plan: Plan, out: Path) -> None:
    """Writes the plan for `keepers_before`, and removes archives of machines that only the plan before has: they
    hold keys. Raises StoreError where it cannot."""
    names = {host.name for host in plan.hosts}
    gone = [out / f"{host.name}.tar.gz" for host in _before(out).hosts if host.name not in names]
    with writing(out / PLAN):
        for archive in filter(Path.exists, gone):
            archive.unlink()
            print(f"{archive}: removed, as the plan has no machine of this name", file=sys.stderr)
        write_file(out / PLAN, as_json(plan).encode())


def keepers_before(out: Path, run_id: str) -> dict[str, str]:
    """Keeper -> machine, in the plan of the same run whose archives were written to a folder before; empty if there
    is none. Raises StoreError where it cannot be read."""
    before = _before(out)
    if before.run_id != run_id:
        return {}
    return {process.id: host.name for host in before.hosts for process in host.processes if process.role == KEEPER}


def _before(out: Path) -> _Before:
    path = out / PLAN
    if not path.exists():
        return _Before()
    try:
        return msgspec.json.decode(read_bytes(path, FileKind.RUN), type=_Before)
    except msgspec.DecodeError as error:
        raise StoreError(f"{path} is no plan of `swarm deploy plan`: {error}; write to another folder") from error


def _archive(out: Path, name: str, texts: dict[str, str], files: Mapping[str, Path]) -> Path:
    """Only its owner may read it: it holds private keys."""
    path = out / f"{name}.tar.gz"

    def entry(place: str, size: int, mode: int) -> tarfile.TarInfo:
        made = tarfile.TarInfo(f"swarm-{name}/{place}")
        made.size, made.mode, made.mtime = size, mode, int(time.time())
        return made

    texts[CONTENTS] = "".join(f"{place}\n" for place in (*texts, *files))
    with private_file(path) as file, tarfile.open(fileobj=file, mode="w:gz") as archive:
        for place, text in texts.items():
            is_script = "." not in place and "/" not in place and place != CONTENTS
            data = text.encode()
            archive.addfile(entry(place, len(data), 0o755 if is_script else 0o644), io.BytesIO(data))
        for place, source in files.items():
            with source.open("rb") as content:
                size = os.fstat(content.fileno()).st_size
                archive.addfile(entry(place, size, 0o600 if place.endswith(".key") else 0o644), content)
    return path


# --- the scenario of a machine: its own endpoints and certificates, files beside it -----------------------------


def host_scenario(plan: Plan, host: PlannedHost) -> tuple[Scenario, dict[str, Path]]:
    """The scenario of a machine with paths relative to its file, and where its files come from: path there -> file
    here. Each file that the terrain names lies below `GROUND`. Raises ConfigError on a file that cannot be taken
    along alone."""
    files: dict[str, Path] = {}
    folders: dict[Path, int] = {}
    """Files of one folder stay together and apart from others: what belongs to a file is found by its name."""

    def beside(key: str, name: str) -> str:
        path = Path(name)
        if path.suffix.lower() in _NAMES_OTHERS:
            raise ConfigError(
                f"{name} names other files, so it cannot be put into an archive alone: let the scenario name a"
                " raster of its own, such as a GeoTIFF"
            )
        place = f"{GROUND}/{folders.setdefault(path.parent, len(folders))}/{path.name}"
        files[place] = path
        files.update((str(Path(place).with_name(part.name)), part) for part in parts_of(path))
        return place

    scenario = with_files(plan.scenario, beside)
    network = msgspec.structs.replace(
        scenario.network,
        listen=host.listen or scenario.network.listen,
        connect=host.connect,
        peers=host.peers,
        tls=TlsConfig(ca=f"{CERTIFICATES}/ca.pem", certificate=CERTIFICATES, key=CERTIFICATES),
    )
    scenario = msgspec.structs.replace(scenario, network=network, seconds=UNTIL_STOPPED_S, plugin_folder=PLUGINS)
    return scenario, files if host.has_files else {}


def parts_of(path: Path) -> list[Path]:
    """The files beside one that belong to it: x.dbf and x.prj to x.shp, x.tfw and x.tif.aux.xml to x.tif."""
    names = [*(f"{path.stem}{suffix}" for suffix in _BESIDE), *(f"{path.name}{suffix}" for suffix in _BESIDE)]
    return [found for name in names if (found := path.with_name(name)) != path and found.is_file()]


def plugin_files(scenario: Scenario) -> dict[str, Path]:
    """The modules of plug-ins that a scenario takes from its own folder, and those beside them."""
    folder = Path(scenario.plugin_folder)
    modules = {
        named.name.partition(":")[0].partition(".")[0] for named in plugins_of(scenario) if ":" in named.name
    }
    if not any((folder / f"{module}.py").is_file() or (folder / module).is_dir() for module in modules):
        return {}
    packages = [path for module in modules for path in sorted((folder / module).rglob("*.py"))]
    return {f"{PLUGINS}/{path.relative_to(folder)}": path for path in (*sorted(folder.glob("*.py")), *packages)}
