"""What a sweep needs beside `terrain-swarm[all]`."""

from __future__ import annotations

from importlib.util import find_spec

from swarm.errors import ConfigError


def check_installed() -> None:
    """Raises ConfigError if something is not installed."""
    for package in ("distributed", "pyarrow"):
        if find_spec(package) is None:
            raise ConfigError(
                f"swarm sweep needs {package}, which is not installed: pip install 'terrain-swarm[sweep]'"
            )
