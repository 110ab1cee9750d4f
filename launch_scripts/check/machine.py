"""This machine and this installation, one finding for each thing that a swarm needs."""

from __future__ import annotations

import ctypes
import importlib.metadata
import os
import platform
import resource
import shutil
import time
import webbrowser
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from launch_scripts.check.findings import Finding, failure, ok, warning
from launch_scripts.check.needs import available_bytes
from launch_scripts.observe.run_folder import can_write
from swarm.config.input_files import size
from swarm.config.scenario import NetworkConfig, Scenario
from swarm.errors import SwarmError

PACKAGE = "terrain-swarm"
_EXTRAS = ("all", "roles", "vectors")
"""What the command needs beside what is always there."""
_ENOUGH_BYTES = 1 << 30
_ENOUGH_DISK_BYTES = 1 << 30
_ENOUGH_FILES = 1024
_COARSE_S = 1e-3
_UNSYNCHRONISED = 5
"""What `adjtimex` returns of a clock that nobody sets: TIME_ERROR."""
_TIMEX_BYTES = 256


def examine(runs: Path) -> Iterator[Finding]:
    """Everything, one after the other. A thing that cannot be looked at is a warning, never an error."""
    for about, look in CHECKS.items():
        try:
            yield look(about, runs)
        except (SwarmError, OSError, ValueError, ImportError) as error:
            yield warning(about, f"cannot be looked at: {error}")


def _python(about: str, runs: Path) -> Finding:
    wanted = importlib.metadata.metadata(PACKAGE)["Requires-Python"] or ""
    from packaging.specifiers import SpecifierSet

    here = platform.python_version()
    if not SpecifierSet(wanted).contains(here, prereleases=True):
        return failure(about, f"{here}, expected {wanted}; make an environment with a newer one")
    return ok(about, f"{here} ({wanted})")


def _packages(about: str, runs: Path) -> Finding:
    from packaging.requirements import Requirement

    wrong, fine = [], 0
    for text in importlib.metadata.requires(PACKAGE) or ():
        wanted = Requirement(text)
        asked = wanted.marker is None or any(wanted.marker.evaluate({"extra": extra}) for extra in _EXTRAS)
        if wanted.name == PACKAGE or not asked:
            continue
        here = _version(wanted.name)
        if here is None:
            wrong.append(f"{wanted.name} is missing ({wanted.specifier})")
        elif not wanted.specifier.contains(here, prereleases=True):
            wrong.append(f"{wanted.name} is {here}, expected {wanted.specifier}")
        else:
            fine += 1
    if wrong:
        return failure(about, f"{'; '.join(wrong)}: pip install 'terrain-swarm[all]'")
    return ok(about, f"{fine} are as pinned; {PACKAGE} {_version(PACKAGE)}, zenoh {_version('eclipse-zenoh')}")


def _kernels(about: str, runs: Path) -> Finding:
    from planner_service.kernel_build import all_kernels
    from planner_service.kernels.compile import cache_folder, code_folder, is_on_disk

    folder = code_folder()
    if folder is None:
        return failure(
            about, "compiled planners can be kept nowhere, so every start compiles: set NUMBA_CACHE_DIR to a folder"
        )
    kernels = list(all_kernels())
    cold = sum(not is_on_disk(kernel) for kernel in kernels)
    if cold and cache_folder() is None:
        return failure(
            about,
            f"{cold} of {len(kernels)} are not in {folder}, which can only be read, so every start compiles them:"
            " `python -m planner_service.kernel_build` makes them where it can be written to",
        )
    if cold:
        return warning(about, f"{cold} of {len(kernels)} are not compiled yet: the first start takes half a minute")
    return ok(about, f"all {len(kernels)} are compiled, in {folder}")


def _cores(about: str, runs: Path) -> Finding:
    cores, load = len(os.sched_getaffinity(0)), os.getloadavg()[0]
    if cores < 2:
        return warning(about, "1: processes take turns, so ticks will be late; two are enough for the demo")
    if load > cores:
        return warning(about, f"{cores}, with a load of {load:.1f} from other work: ticks will be late")
    return ok(about, f"{cores}, load {load:.1f}")


def _memory(about: str, runs: Path) -> Finding:
    free = available_bytes()
    if free is None:
        return warning(about, "not known on this system; the demo takes about 0.6 GB")
    if free < _ENOUGH_BYTES:
        return warning(about, f"{size(free)} are free; the demo takes about 0.6 GB: end something else first")
    return ok(about, f"{size(free)} are free")


def _files(about: str, runs: Path) -> Finding:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != resource.RLIM_INFINITY and soft < _ENOUGH_FILES:
        return warning(about, f"{soft} at a time, too few for a router of many: `ulimit -n {min(4096, hard)}`")
    return ok(about, "any number at a time" if soft == resource.RLIM_INFINITY else f"{soft} at a time")


def _shared_memory(about: str, runs: Path) -> Finding:
    folder = Path("/dev/shm")
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        return warning(about, "/dev/shm cannot be written; in a container, mount a tmpfs there")
    return ok(about, f"{size(shutil.disk_usage(folder).free)} are free")


def _zenoh(about: str, runs: Path) -> Finding:
    from launch_scripts.ports import free_ports
    from swarm.bus.zenoh_bus import open_bus

    (port,) = free_ports(1)
    endpoint = f"tcp/127.0.0.1:{port}"
    network = NetworkConfig(listen=(endpoint,), connect=(endpoint,), connect_timeout_s=5.0)
    began_s = time.monotonic()
    try:
        with open_bus(network, mode="router"), open_bus(network):
            took_ms = (time.monotonic() - began_s) * 1e3
    except SwarmError as error:
        return failure(about, f"no session over loopback: {error}; is there a firewall on 127.0.0.1?")
    return ok(about, f"two sessions met on 127.0.0.1:{port} within {took_ms:.0f} ms")


def _ports(about: str, runs: Path) -> Finding:
    from launch_scripts.ports import check_ports
    from swarm.errors import BusError

    try:
        check_ports(Scenario(), ("router", "monitor"))
    except BusError as error:
        return warning(about, str(error))
    return ok(about, "those of scenarios that name none are free")


def _clock(about: str, runs: Path) -> Finding:
    resolution_s = max(time.get_clock_info(name).resolution for name in ("monotonic", "time"))
    if resolution_s > _COARSE_S:
        return warning(about, f"its resolution is {resolution_s * 1e3:g} ms, ticks need 1 ms")
    state = _clock_state()
    if state == _UNSYNCHRONISED:
        return warning(about, "not synchronised (no NTP), which several machines need: start chrony or ntpd")
    known = "whether it is synchronised is not known" if state is None else "synchronised"
    return ok(about, f"resolution {resolution_s * 1e9:.0f} ns, {known}")


def _clock_state() -> int | None:
    """What the kernel says of its clock; None where it says nothing."""
    try:
        # All zero asks and changes nothing.
        state: int = ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(_TIMEX_BYTES))
    except (OSError, AttributeError):
        return None
    return state if state >= 0 else None


def _view(about: str, runs: Path) -> Finding:
    here = shutil.which("rerun")
    native = f"; {here} opens recordings" if here else ""
    try:
        browser = webbrowser.get()
    except webbrowser.Error:
        return warning(
            about,
            "no browser here: open the page that `swarm up` names from another computer, by the ssh line beside"
            f" it{native}",
        )
    return ok(about, f"a browser for the live view: {getattr(browser, 'name', None) or 'yes'}{native}")


def _disk(about: str, runs: Path) -> Finding:
    folder = next(path for path in (runs.absolute(), *runs.absolute().parents) if path.exists())
    if not folder.is_dir():
        return failure(about, f"{folder} is not a folder; choose another --runs")
    try:
        can_write(folder)
    except OSError as error:
        return failure(about, f"{folder} cannot be written: {error.strerror or error}; choose another --runs")
    free = shutil.disk_usage(folder).free
    if free < _ENOUGH_DISK_BYTES:
        return warning(about, f"{size(free)} are free in {folder}; a minute of a large swarm writes some 20 MB")
    return ok(about, f"{size(free)} are free in {folder}")


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


CHECKS: dict[str, Callable[[str, Path], Any]] = {
    "python": _python,
    "packages": _packages,
    "planner kernels": _kernels,
    "cores": _cores,
    "memory": _memory,
    "open files": _files,
    "shared memory": _shared_memory,
    "zenoh": _zenoh,
    "ports": _ports,
    "clock": _clock,
    "view": _view,
    "disk": _disk,
}
"""What is looked at, in order."""
