"""The type of the fixture `swarm`."""

from collections.abc import Callable

Swarm = Callable[..., tuple[int, str, str]]
"""The command line -> (exit code, standard output, standard error)."""
