"""One archive for each machine of a plan: its scenario, its certificates and no others, its files, its service."""

from __future__ import annotations

import io
import json
import os
import tarfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from launch_scripts.deploy.certificates import CA, THIS_MACHINE, authority, called_of, hosts_of, issue
from launch_scripts.deploy.host_scenario import CERTIFICATES, GROUND, PLUGINS, host_scenario, parts_of
from launch_scripts.deploy.plan import ROUTER, Plan, PlannedHost
from launch_scripts.deploy.revocations import FILE as REVOKED
from launch_scripts.deploy.revocations import revoked_in
from launch_scripts.deploy.shown_plan import as_json
from launch_scripts.process_table import OPERATOR
from swarm.bus.access_control import common_name
from swarm.config.plugin_names import plugins_of
from swarm.config.scenario import Scenario
from swarm.config.write import scenario_text
from swarm.errors import StoreError

Render = Callable[[Plan, PlannedHost], Mapping[str, str]]
"""Name -> text of the files that start a machine's processes. Names without an ending are scripts."""
_PRIVATE, _OPEN, _SCRIPT = 0o600, 0o644, 0o755


def write_kits(plan: Plan, out: Path, render: Render, days: int, wheel: Path | None = None) -> list[Path]:
    """An archive for each machine, `out/NAME.tar.gz`, which unpacks into `swarm-NAME/`. Returns the archives.

    Certificates lie in `out/certs` with the authority's key, which leaves it for no archive. What is there already
    is kept, so that a second plan replaces no key that needs none. Raises StoreError where a file cannot be read or
    written.
    """
    folder = out / CERTIFICATES
    revoked = revoked_in(folder)
    authority(folder)
    _issued(folder, OPERATOR, (), days, revoked)
    written = []
    for host in plan.hosts:
        scenario, ground = host_scenario(plan, host)
        texts = {
            "scenario.toml": scenario_text(scenario, Path()),
            "plan.json": json.dumps(as_json(plan), indent=1) + "\n",
            **render(plan, host),
        }
        if revoked and host.of(ROUTER):
            texts[f"{CERTIFICATES}/{REVOKED}"] = "".join(f"{name}\n" for name in revoked)
        files = {**ground, **_plugin_files(plan.scenario), **_certificates(folder, host, days, revoked)}
        if wheel is not None:
            files[f"wheels/{wheel.name}"] = wheel
        written.append(_archive(out, host.name, texts, files))
    return written


def _certificates(folder: Path, host: PlannedHost, days: int, revoked: tuple[str, ...]) -> dict[str, Path]:
    """Place in the archive -> file, of the certificates of a machine's processes. Its launcher's, whose name is the
    machine's own, lies where `swarm up` looks for an operator's."""
    found = {f"{CERTIFICATES}/{CA}.pem": folder / f"{CA}.pem"}
    named = [(process.certificate, process.certificate, process.role) for process in host.processes]
    for name, place, role in (*named, (host.operator, OPERATOR, "")):
        reached = (host.address, *THIS_MACHINE) if role == ROUTER else ()
        certificate = _issued(folder, name, reached, days, revoked)
        for suffix in (".pem", ".key"):
            found[f"{CERTIFICATES}/{place}{suffix}"] = certificate.with_name(f"{name}{suffix}")
    return found


def _issued(folder: Path, name: str, hosts: tuple[str, ...], days: int, revoked: tuple[str, ...]) -> Path:
    """The certificate of a name: the one that is there, or a new one if it lacks a host or its name was revoked."""
    path, called = folder / f"{name}.pem", common_name(name, revoked)
    renew = path.exists()
    if renew and hosts_of(path) >= set(hosts) and called_of(path) == called:
        return path
    return issue(folder, name, hosts, days, renew=renew, called=called)


def _plugin_files(scenario: Scenario) -> dict[str, Path]:
    """The modules of plug-ins that a scenario takes from its own folder, and those beside them."""
    folder = Path(scenario.plugin_folder)
    modules = {
        named.name.partition(":")[0].partition(".")[0] for named in plugins_of(scenario) if ":" in named.name
    }
    if not any((folder / f"{module}.py").is_file() or (folder / module).is_dir() for module in modules):
        return {}
    packages = [path for module in modules for path in sorted((folder / module).rglob("*.py"))]
    return {f"{PLUGINS}/{path.relative_to(folder)}": path for path in (*sorted(folder.glob("*.py")), *packages)}


def _archive(out: Path, name: str, texts: Mapping[str, str], files: Mapping[str, Path]) -> Path:
    """Only its owner may read it: it holds private keys."""
    path = out / f"{name}.tar.gz"
    partial = path.with_name(f".{path.name}.part")
    try:
        descriptor = os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, _PRIVATE)
        with open(descriptor, "wb") as file, tarfile.open(fileobj=file, mode="w:gz") as archive:
            for place, text in texts.items():
                data = text.encode()
                mode = _SCRIPT if "." not in Path(place).name and "/" not in place else _OPEN
                archive.addfile(_entry(name, place, len(data), mode), io.BytesIO(data))
            for place, source in _with_parts(files):
                with source.open("rb") as content:
                    size = os.fstat(content.fileno()).st_size
                    mode = _PRIVATE if place.endswith(".key") else _OPEN
                    archive.addfile(_entry(name, place, size, mode), content)
        partial.replace(path)
    except OSError as error:
        raise StoreError(f"cannot write {path}: {error.filename or partial}: {error.strerror or error}") from error
    return path


def _with_parts(files: Mapping[str, Path]) -> Iterator[tuple[str, Path]]:
    """With what belongs to a file by its name, as .shp, .dbf and .prj."""
    for place, source in files.items():
        yield place, source
        if place.startswith(f"{GROUND}/"):
            for part in parts_of(source):
                yield str(Path(place).with_name(part.name)), part


def _entry(host: str, place: str, size: int, mode: int) -> tarfile.TarInfo:
    entry = tarfile.TarInfo(f"swarm-{host}/{place}")
    entry.size, entry.mode, entry.mtime = size, mode, int(time.time())
    return entry
