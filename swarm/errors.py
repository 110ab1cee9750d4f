"""The errors that a user may see: each has one clear sentence and an exit code, and is shown without a
traceback."""

from __future__ import annotations

from importlib.util import find_spec

EXTRAS = {
    "typer": "terrain", "rich": "terrain", "numpy": "planner", "numba": "planner", "llvmlite": "planner",
    "PIL": "terrain", "matplotlib": "terrain", "packaging": "terrain", "rasterio": "terrain", "scipy": "terrain",
    "yaml": "terrain", "cryptography": "roles", "jinja2": "roles", "markupsafe": "roles",
    "prometheus_client": "roles", "psutil": "terrain", "setproctitle": "roles", "rerun": "view", "dask": "sweep",
    "pyogrio": "vectors", "shapely": "roles", "pyproj": "wgs84", "pymavlink": "mavlink", "serial": "mavlink",
    "mcap": "ros2", "rosbags": "ros2", "xxhash": "ros2", "distributed": "sweep", "pyarrow": "sweep",
}  # fmt: skip
"""Package that the base install lacks -> the smallest extra which brings it."""


def missing(package: str, extra: str | None = None) -> str:
    """End of a sentence about a package which is not installed; `extra` is the smallest which brings it, if no
    larger one is needed."""
    extra = extra or EXTRAS[package]
    return f"{package}, which is not installed: install the extra '{extra}' (docs/start/install.md)"


def require(module: str, *packages: str) -> None:
    """Raises ModuleNotFoundError, with the extra to install, if a module lacks one of its packages."""
    for package in packages:
        if find_spec(package) is None:
            raise ModuleNotFoundError(f"{module} needs {missing(package)}", name=package)


class SwarmError(Exception):
    """A fault of the input, a file or the network, explained in one sentence. A fault of ours is any other
    exception."""

    exit_code = 1


class ConfigError(SwarmError):
    """A scenario, an option or a value that is not what it must be."""

    exit_code = 2


class ArgumentError(ConfigError, ValueError, TypeError):
    """An argument of a call from Python that is not what it must be; also one of Python's own errors for that."""


class TerrainError(SwarmError):
    """A terrain or photo that cannot be read, or on which every cell is lethal."""

    exit_code = 3


class BusError(SwarmError):
    """The network cannot be opened or reached: port taken, no router, certificate rejected."""

    exit_code = 4


class NoAnswerError(BusError):
    """No process has answered a question, nor refused it: none serves it, or the one which did has just ended."""


class RunMismatchError(SwarmError):
    """Two processes in one namespace belong to different runs, or have different terrain or cost rules."""

    exit_code = 5


class StoreError(SwarmError):
    """The keeper's store or a run folder cannot be opened or written."""

    exit_code = 6


class DamagedError(SwarmError):
    """A store that is not as it was written. A full disk gets better (`StoreError`), a damaged record does not."""

    exit_code = StoreError.exit_code


class ProtocolError(SwarmError):
    """A payload that is no message, or a message that breaks its rules. The bus counts and drops it; no service
    sees it."""


class OutsideGridError(ArgumentError):
    """A cell outside the grid where one inside it is required: in a process of the swarm a bug, as every
    `ArgumentError` there."""
