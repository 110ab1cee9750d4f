"""Which code a simulation runs: a digest of the sources that can change its result, and versions of libraries."""

from __future__ import annotations

import hashlib
import importlib
import importlib.metadata
import platform
from functools import cache
from pathlib import Path

_PACKAGES = (
    "swarm",
    "shared_map",
    "planner_service",
    "vehicle_agent",
    "launch_scripts.simulation",
    "launch_scripts.simulation.world",
    "launch_scripts.report",
)
_LIBRARIES = ("msgspec", "numba", "numpy", "scipy")
_BYTES = 8


@cache
def code_version() -> str:
    """Hexadecimal digits, the same on machines with the same sources and versions. Documentation in the sources
    counts, too: what is simulated once more costs less than what is wrongly kept."""
    digest = hashlib.blake2b(digest_size=_BYTES)
    for name in _PACKAGES:
        folder = Path(importlib.import_module(name).__path__[0])
        for path in sorted(folder.rglob("*.py")):
            digest.update(f"{name}/{path.relative_to(folder).as_posix()}\0".encode())
            digest.update(hashlib.blake2b(path.read_bytes()).digest())
    versions = [platform.python_version(), *map(importlib.metadata.version, _LIBRARIES)]
    digest.update(" ".join(versions).encode())
    return digest.hexdigest()
