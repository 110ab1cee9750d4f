"""The type of the fixture `swarm`."""

from __future__ import annotations

from collections.abc import Callable

Swarm = Callable[..., tuple[int, str, str]]
"""The command line -> (exit code, standard output, standard error)."""
