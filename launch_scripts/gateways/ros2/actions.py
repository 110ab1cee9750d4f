"""What the gateway's core tells its shell to do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple


class Channel(NamedTuple):
    """One topic in ROS.

    row    name of its row in the table
    topic  with its leading slash
    """

    row: str
    topic: str


@dataclass(frozen=True, slots=True)
class Declare:
    """Put topics up: a publisher with its token each."""

    channels: tuple[Channel, ...]


@dataclass(frozen=True, slots=True)
class Remove:
    """Take topics down."""

    channels: tuple[Channel, ...]


@dataclass(frozen=True, slots=True)
class Put:
    """Put a message; bytes are CDR already."""

    channel: Channel
    message: Any


Action = Declare | Remove | Put
