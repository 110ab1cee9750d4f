"""Digests: the (epoch, seq) of each author's sets that a replica holds, how two such tables differ (`Ledger`), and
received digests that still have to be compared with the held sets (`PendingDigests`). Pure: time is an argument."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain, islice, zip_longest

import numpy as np
from numpy.typing import NDArray

from swarm.clock import NS_PER_S
from swarm.peers import Newest
from swarm.wire.messages.map_data import DIGEST_ROW, DIGEST_ROW_BYTES, Digest

_FEW = 64
"""Rows up to which tuples are compared faster than arrays: digests of late changes come several times a second."""

Held = Mapping[str, bytes]
"""Author -> rows of DIGEST_ROW, as in the message `Digest`."""
Place = tuple[str, int]
"""An author and a tile, in whose order sets are named."""


_NONE = (-1, -1)
"""Below the number of any set."""


class Ledger:
    """Numbers (epoch, seq) of the mark sets which a replica holds, by author and tile, as rows for digests."""

    def __init__(self) -> None:
        self._numbers: dict[str, dict[int, tuple[int, int]]] = {}  # author -> tile -> (epoch, seq)
        self._rows: dict[str, NDArray[np.void]] = {}  # author -> the same in order of tile, until one changes

    def record(self, author: str, tile: int, epoch: int, seq: int) -> None:
        """Notes that an author's set of this tile is held under this number."""
        self._numbers.setdefault(author, {})[tile] = (epoch, seq)
        self._rows.pop(author, None)

    def drop(self, author: str, tile: int) -> None:
        """Notes that an author's set of this tile is not held any more."""
        numbers = self._numbers.get(author, {})
        if numbers.pop(tile, None) is not None:
            self._rows.pop(author, None)
            if not numbers:
                del self._numbers[author]

    def tiles_of(self, author: str) -> list[int]:
        """Tiles of which a set of an author is held, in order."""
        return sorted(self._numbers.get(author, ()))

    @property
    def authors(self) -> list[str]:
        """Authors of whom a set is held, in order."""
        return sorted(self._numbers)

    def authors_from(self, place: int, most: int) -> list[str]:
        """Authors with a held set, ordered by their first set, from position `place` on."""
        return list(islice(self._numbers, place, place + most))

    def held(self, authors: list[str] | None = None) -> dict[str, bytes]:
        """Rows in order of author and tile: equal holdings give equal bytes."""
        names = self.authors if authors is None else [name for name in authors if name in self._numbers]
        return {name: self._sorted(name).tobytes() for name in names}

    def rows_of(self, author: str, tiles: Iterable[int]) -> bytes:
        """Rows of an author's sets of these tiles, in order of tile; of tiles without a set none."""
        numbers = self._numbers.get(author, {})
        return digest_rows((tile, *numbers[tile]) for tile in sorted(tiles) if tile in numbers).tobytes()

    def missing(self, theirs: Held) -> list[tuple[str, list[int]]]:
        """Returns (author, tiles) of each author of whom they hold newer sets than we."""
        found = []
        for author in sorted(theirs):
            rows = np.frombuffer(theirs[author], DIGEST_ROW)
            if len(rows) <= _FEW:
                ours = self._numbers.get(author, {})
                tiles = [tile for tile, *number in rows.tolist() if tuple(number) > ours.get(tile, _NONE)]
            else:
                tiles = rows["tile"][_newer(rows, self._sorted(author))].tolist()
            if tiles:
                found.append((author, sorted(set(tiles))))
        return found

    def ahead(
        self, theirs: Held, authors: list[str], after: Place | None = None, until: Place | None = None
    ) -> list[tuple[str, list[int]]]:
        """(author, tiles) of these authors of which we hold a newer set than they.

        after, until  range which `theirs` covers, as in `Digest`
        """
        found = []
        for author in authors:
            if (after is not None and author < after[0]) or (until is not None and author > until[0]):
                continue
            rows = self._sorted(author)
            if after is not None and author == after[0]:
                rows = rows[rows["tile"] > after[1]]
            if until is not None and author == until[0]:
                rows = rows[rows["tile"] <= until[1]]
            rows = rows[_newer(rows, np.sort(np.frombuffer(theirs.get(author, b""), DIGEST_ROW)))]
            if len(rows):
                found.append((author, rows["tile"].tolist()))
        return found

    def _sorted(self, author: str) -> NDArray[np.void]:
        numbers = self._numbers.get(author, {})
        if author not in self._rows and numbers:
            self._rows[author] = digest_rows((tile, *numbers[tile]) for tile in sorted(numbers))
        return self._rows.get(author, _NO_ROWS)


def digest_rows(numbers: Iterable[tuple[int, int, int]]) -> NDArray[np.void]:
    """Rows of a digest from (tile, epoch, seq)."""
    return np.array(list(numbers), DIGEST_ROW)


def _newer(rows: NDArray[np.void], base: NDArray[np.void]) -> NDArray[np.bool_]:
    """Returns which of `rows` are newer than the row of the same tile in `base`, or have none there: bool (rows,).

    base  in order of tile
    """
    if not len(base):
        return np.ones(len(rows), bool)
    # If a garbled digest has a tile twice, the last and thus the newest row of `base` counts.
    place = np.searchsorted(base["tile"], rows["tile"], side="right") - 1
    there = base[np.maximum(place, 0)]
    known = (place >= 0) & (there["tile"] == rows["tile"])
    later = (rows["epoch"] > there["epoch"]) | ((rows["epoch"] == there["epoch"]) & (rows["seq"] > there["seq"]))
    return np.asarray(~known | later, bool)


_NO_ROWS = digest_rows(())


def fingerprint(held: Held) -> str:
    """16 hex digits that are equal where holdings are."""
    hashed = hashlib.blake2b(digest_size=8)
    for author in sorted(held):
        hashed.update(f"{author}:{len(held[author])}:".encode())
        hashed.update(held[author])
    return hashed.hexdigest()


_NAME_BYTES = 80
"""Most bytes of an author in a message, beside its rows."""


def parts_of(held: Held, most_bytes: int) -> Iterator[tuple[dict[str, bytes], Place | None, Place | None]]:
    """Splits the rows of a digest into parts, one if all fit. Yields (rows by author, `after`, `until`) of each;
    the last two as in `Digest`.

    held        author -> rows; authors in order, the rows of each in order of tile
    most_bytes  of a part: its rows and the names of its authors
    """
    part: dict[str, bytes] = {}
    left, after, last = most_bytes, None, None
    for author, rows in held.items():
        at = 0
        while at < len(rows):
            if left < _NAME_BYTES + DIGEST_ROW_BYTES:
                yield part, after, last
                part, left, after = {}, most_bytes, last
            taken = rows[at : at + (left - _NAME_BYTES) // DIGEST_ROW_BYTES * DIGEST_ROW_BYTES]
            at += len(taken)
            left -= _NAME_BYTES + len(taken)
            part[author] = taken
            last = author, int(np.frombuffer(taken[-DIGEST_ROW_BYTES:], DIGEST_ROW)["tile"][0])
    yield part, after, None


_GRACE_NS = NS_PER_S // 10
"""A digest may overtake the sets that it names: missing sets are requested only this long after it came."""
_RETRY_NS = NS_PER_S * 15 // 100
"""Interval between requests for missing sets; with 30 % of all messages lost replicas agree within two seconds."""
_MAX_TRIES = 10
"""After these the sender has sent its next whole digest, which starts again."""
_MAX_SENDERS = 4096
"""Senders whose order and parts are kept: bounds the memory. Chosen, not measured."""
_MAX_PARTS = 128
"""Most that wait of one sender: a keeper's digest of every tile of a map of 16,384 x 16,384 cells has 85."""
_MAX_BYTES = 64 << 20
"""A digest that would exceed this is dropped: its sender repeats it within seconds."""
_FORGET_NS = 60 * NS_PER_S
"""A sender that was silent for this time loses its place in the order."""
_AT_ONCE = 1024
"""Authors, and every `_ROWS` rows, that are compared in one tick: some 5 ms."""
_ROWS = 16
"""Rows of a digest that count as one unit of the work of a tick."""


@dataclass(slots=True)
class PendingDigest:
    """A digest that waits for its comparison.

    due_ns  compare it then
    tries   how often it was compared
    """

    digest: Digest
    due_ns: int
    tries: int = 0

    @property
    def size(self) -> int:
        """Bytes in memory, about."""
        return 1000 + sum(map(len, self.digest.held.values())) + 100 * len(self.digest.held)

    @property
    def cost(self) -> int:
        """Work of one comparison, in the unit of `_AT_ONCE`."""
        rows = sum(map(len, self.digest.held.values())) // DIGEST_ROW_BYTES
        return len(self.digest.held) + rows // _ROWS + 1


@dataclass(slots=True)
class _Sender:
    """A sender and its newest digests, by what they cover: one of late changes does not replace the last whole
    one."""

    heard_ns: int = 0
    pending: dict[tuple[bool, Place | None], PendingDigest] = field(default_factory=dict)


class PendingDigests:
    """The newest digest of each sender until nothing that it names is missing. Bounded in senders and bytes.

    Senders of due digests take turns, the longest known first; so newly invented names delay no known sender.
    """

    def __init__(self) -> None:
        self._senders: dict[str, _Sender] = {}  # in order of appearance
        self._bytes = 0  # sum of `size` of what is pending
        self._newest = Newest(_MAX_SENDERS)  # of the digests whose senders count them
        self._forget_due_ns = 0

    def add(self, digest: Digest, now_ns: int) -> bool:
        """Takes in a digest; false if a newer one of its sender overtook it, or if there is no space for it."""
        stream = digest.whole, digest.after
        if digest.seq and not self._newest.is_news((digest.author, *stream), (0, digest.seq), now_ns):
            return False
        sender = self._sender(digest.author, now_ns)
        if sender is None:
            return False
        new = PendingDigest(digest, now_ns + _GRACE_NS)
        if (replaced := sender.pending.pop(stream, None)) is not None:
            new.due_ns = min(replaced.due_ns, new.due_ns)
            self._bytes -= replaced.size
        if self._bytes + new.size <= _MAX_BYTES and len(sender.pending) < _MAX_PARTS:
            sender.pending[stream] = new
            self._bytes += new.size
        return True

    def _sender(self, name: str, now_ns: int) -> _Sender | None:
        """A sender that is heard now; None if there is no room for it."""
        if name not in self._senders:
            if len(self._senders) >= _MAX_SENDERS and now_ns >= self._forget_due_ns:
                self._forget_due_ns = now_ns + NS_PER_S
                self._senders = {
                    each: of for each, of in self._senders.items() if now_ns - of.heard_ns < _FORGET_NS
                }
                self._bytes = sum(each.size for of in self._senders.values() for each in of.pending.values())
            if len(self._senders) >= _MAX_SENDERS:
                return None
            self._senders[name] = _Sender()
        self._senders[name].heard_ns = now_ns
        return self._senders[name]

    def due(self, now_ns: int) -> Iterator[PendingDigest]:
        """Those to compare in this tick."""
        ready = ([each for each in of.pending.values() if now_ns >= each.due_ns] for of in self._senders.values())
        left = _AT_ONCE
        for each in chain.from_iterable(zip_longest(*ready)):
            if left <= 0:
                return
            if each is not None:
                left -= each.cost
                yield each

    def compared(self, pending: PendingDigest, complete: bool, now_ns: int) -> None:
        """Notes a comparison: a digest is done if all of its sets are held, else due again, at most ten times."""
        pending.tries += 1
        pending.due_ns = now_ns + _RETRY_NS
        if complete or pending.tries > _MAX_TRIES:
            digest = pending.digest
            del self._senders[digest.author].pending[digest.whole, digest.after]
            self._bytes -= pending.size

    def hasten(self, now_ns: int) -> None:
        """Compares all of them at once: a link has come back."""
        for of in self._senders.values():
            for pending in of.pending.values():
                pending.due_ns = now_ns
