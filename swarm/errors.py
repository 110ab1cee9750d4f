"""The errors a person may see. Each carries one clear sentence and an exit code; none shows a traceback."""

from __future__ import annotations


class SwarmError(Exception):
    """Something the user, a file or the network did that a sentence can explain."""

    exit_code = 1


class ConfigError(SwarmError):
    """A scenario, an option or a value that is not what it must be."""

    exit_code = 2


class TerrainError(SwarmError):
    """A terrain or photo that cannot be read, or that no vehicle could stand on."""

    exit_code = 3


class BusError(SwarmError):
    """The network cannot be opened or reached: port taken, nobody listening, certificate refused."""

    exit_code = 4


class RunMismatchError(SwarmError):
    """Two processes in one namespace that do not belong to the same run, or see different terrain."""

    exit_code = 5


class StoreError(SwarmError):
    """The keeper's store or a run folder cannot be opened or written."""

    exit_code = 6


class ProtocolError(SwarmError):
    """A payload from the network that does not parse. Counted and dropped at the door, never raised past it."""


class OutsideGridError(ValueError):
    """A cell outside the grid reached code that was promised a cell inside it: a bug of ours."""
