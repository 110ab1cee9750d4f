"""The processes of a run: the ranks in their ids, which of them are alive, and which of their messages are news.

The process of rank 0 is named after its job: planner `t3` serves target t3. Its standbys are `t3.r1`, `t3.r2` ...
An id is unique and says what its process may serve, so routers can grant access by it. Time is an argument.
"""

from __future__ import annotations

import re
from collections.abc import Hashable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True, order=True)
class Peer:
    """One incarnation of one process. A later incarnation of the same (role, id) replaces the earlier."""

    role: str
    id: str
    incarnation: int


_MOST_LIVES = 64
"""Largest number of tokens of one process: the holder of its certificate may raise any number."""
_MOST_ALIVE = 1 << 14
"""Largest number of processes: on loopback, any program may raise tokens under any name."""


class Roster:
    """The peers whose liveliness tokens are up.

    A token of a new incarnation may appear before that of the old one falls, so all incarnations of a process are
    kept, and the order in which tokens come and go does not matter. Repeated and unknown ones change nothing. Of a
    process with more than 64 tokens only the newest count. Beyond 16,384 processes a newcomer is not noticed.
    """

    def __init__(self) -> None:
        self._alive: dict[tuple[str, str], list[int]] = {}
        """(role, id) -> incarnations whose token is up, rising; without processes that have none."""

    def appeared(self, peer: Peer) -> None:
        """A token is up."""
        if (peer.role, peer.id) not in self._alive and len(self._alive) >= _MOST_ALIVE:
            return
        incarnations = self._alive.setdefault((peer.role, peer.id), [])
        if peer.incarnation not in incarnations:
            incarnations.append(peer.incarnation)
            incarnations.sort()
            del incarnations[:-_MOST_LIVES]

    def gone(self, peer: Peer) -> None:
        """A token has fallen."""
        incarnations = self._alive.get((peer.role, peer.id), [])
        if peer.incarnation in incarnations:
            incarnations.remove(peer.incarnation)
        if not incarnations:
            self._alive.pop((peer.role, peer.id), None)

    def up(self) -> list[tuple[str, str]]:
        """(role, id) of all processes that are alive, in order."""
        return sorted(self._alive)

    def alive(self, role: str) -> dict[str, int]:
        """Id -> newest incarnation of the live processes of a role, in order of id."""
        return {id: incarnations[-1] for (r, id), incarnations in sorted(self._alive.items()) if r == role}

    def is_alive(self, role: str, id: str) -> bool:
        """Returns True if any incarnation of the process is alive."""
        return (role, id) in self._alive


SILENCE_NS = 3_000_000_000
"""A stream that has been silent for this time is heard again from wherever it goes on."""
POSE_SILENCE_NS = 2_000_000_000
"""The same of target poses, which come twice a second at least."""
FOR_GOOD_NS = 1 << 62
"""The same of heartbeats: a process that starts again has another incarnation, so the numbers of one life never
begin again."""


class Newest:
    """Detection of new messages in each stream: those numbered above the last new one.

    After `silence_ns` without a new message, a message with any different number counts as new, also a lower one.
    So one message with a very high number cannot block the stream for ever, and a sender whose clock was set back
    is heard again. A very late message can be accepted by mistake; the next message replaces it.
    """

    def __init__(self, most: int = 4096, silence_ns: int = SILENCE_NS) -> None:
        self._silence_ns = silence_ns
        self._most = most
        """Number of remembered streams: any message of another stream counts as new."""
        self._newest: dict[Hashable, tuple[tuple[int, int], int]] = {}
        """Stream -> the number of its last news, and when that was heard."""

    def is_news(self, stream: Hashable, number: tuple[int, int], now_ns: int) -> bool:
        """Returns True if a message is new, which it is once."""
        known = self._newest.get(stream)
        if known is not None:
            last, heard_ns = known
            if number == last or (number < last and now_ns - heard_ns < self._silence_ns):
                return False
        if known is not None or len(self._newest) < self._most:
            self._newest[stream] = (number, now_ns)
        return True


HIGHEST_RANK = 9
"""One digit in an id. A job with nine standbys is on more machines than may fail together."""
_RANKED = re.compile(rf"(.+)\.r([1-{HIGHEST_RANK}])")


def ranked_id(job: str, rank: int) -> str:
    """The id of the process of this rank for a job."""
    return f"{job}.r{rank}" if rank else job


def split_rank(id: str) -> tuple[str, int]:
    """The job and the rank of a process, by its id."""
    match = _RANKED.fullmatch(id)
    return (id, 0) if match is None else (match[1], int(match[2]))


def job_of(id: str) -> str:
    """Returns the task of a process, independent of its rank."""
    return split_rank(id)[0]
