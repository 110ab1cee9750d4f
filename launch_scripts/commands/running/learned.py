"""What vehicles have learned of kinds of ground, asked of a running swarm, and as a table."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

from launch_scripts.observe.run_observer import frame_of_run
from shared_map.learning.learned import learned_kinds
from shared_map.replication.marks import supersedes
from shared_map.replication.tiles import beyond_tile
from swarm.bus.bus import AskEnded, Replied
from swarm.errors import BusError
from swarm.runtime.inbox import Inbox
from swarm.wire.messages.map_data import MarkSet, MarksRequest
from swarm.wire.topics import MARKS

if TYPE_CHECKING:
    from swarm.bus.bus import Bus

_TIMEOUT_S = 2.0


def ask_learned(bus: Bus, where: object) -> list[MarkSet]:
    """The newest word of each author. Raises BusError if nobody answers.

    where  names the swarm in errors
    """
    beyond = beyond_tile(frame_of_run(bus, where).grid)
    inbox = Inbox()
    bus.ask(MARKS, MarksRequest(tiles=[beyond]), inbox.post, tag="learned", timeout_s=_TIMEOUT_S)
    found: dict[str, MarkSet] = {}
    deadline_s = time.monotonic() + _TIMEOUT_S + 1.0
    while time.monotonic() < deadline_s:
        match inbox.take(0.1):
            case Replied(message=MarkSet() as word) if word.tile == beyond:
                held = found.get(word.author)
                if held is None or supersedes(word, held):
                    found[word.author] = word
            case AskEnded(failure=failure):
                if failure is not None and not found:
                    raise BusError(f"nobody {where} says what was learned: {failure}")
                break
    return [found[author] for author in sorted(found)]


def print_learned(words: Sequence[MarkSet], *, as_json: bool) -> None:
    """Print what was learned of each kind of ground."""
    kinds = learned_kinds(words)
    if as_json:
        print(json.dumps({"kinds": [each._asdict() for each in kinds]}, indent=2))
        return
    console = Console(highlight=False)
    if not kinds:
        console.print("nothing was learned: map.learning is off, or no vehicle has driven yet")
        return
    table = Table("kind of ground, degrees", pad_edge=False)
    for heading in ("cells driven", "authors", "driven / prior pace", "standard error", "factor applied"):
        table.add_column(heading, justify="right")
    for each in kinds:
        factor = "-" if each.factor == 1 else f"{each.factor:.2f}"
        error = f"{each.standard_error:.1%}"
        table.add_row(each.kind, f"{each.cells:,}", f"{each.authors}", f"{each.measured:.2f}", error, factor)
    console.print(table)
    console.print("factor -: not yet 4.5 standard errors from 1, so the prior stands")
