"""Digests: which (epoch, seq) of which author's sets a replica holds, and how two such tables differ."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from swarm.wire.messages.marks import DIGEST_ROW, MarkSet

Held = Mapping[str, bytes]
"""Author -> rows of DIGEST_ROW, as in the message `Digest`."""


class Ledger:
    """What is held, by author and tile. A digest is copied out of it, not computed."""

    def __init__(self) -> None:
        self._authors: dict[str, _Rows] = {}

    def record(self, author: str, tile: int, epoch: int, seq: int) -> None:
        rows = self._authors.get(author)
        if rows is None:
            rows = self._authors[author] = _Rows()
        rows.record(tile, epoch, seq)

    def record_many(self, sets: Sequence[MarkSet]) -> None:
        """As `record` of each; no two of one author and tile."""
        of_author: dict[str, list[MarkSet]] = {}
        for each in sets:
            of_author.setdefault(each.author, []).append(each)
        for author, theirs in of_author.items():
            self.record_rows(
                author,
                [each.tile for each in theirs],
                [each.epoch for each in theirs],
                [each.seq for each in theirs],
            )

    def record_rows(self, author: str, tiles: list[int], epochs: ArrayLike, seqs: ArrayLike) -> None:
        """As `record` of each of an author's sets, given as columns; no tile occurs twice."""
        self._authors.setdefault(author, _Rows()).record_many(tiles, epochs, seqs)

    def drop(self, author: str, tile: int) -> None:
        """Nothing is held any more of this tile of an author."""
        rows = self._authors.get(author)
        if rows is not None and rows.drop(tile) == 0:
            del self._authors[author]

    def forget(self, author: str) -> None:
        self._authors.pop(author, None)

    @property
    def authors(self) -> list[str]:
        return sorted(self._authors)

    def held(self, authors: list[str] | None = None) -> dict[str, bytes]:
        """Rows in order of author and tile: equal holdings give equal bytes."""
        names = self.authors if authors is None else [name for name in authors if name in self._authors]
        return {name: self._authors[name].sorted().tobytes() for name in names}

    def rows_of(self, author: str, tiles: Iterable[int]) -> bytes:
        """Rows of these tiles of an author, as far as it has them."""
        rows = self._authors.get(author)
        return b"" if rows is None else rows.of(tiles).tobytes()

    def missing(self, theirs: Held) -> list[tuple[str, list[int]]]:
        """(author, tiles) of which they hold a newer set than we."""
        found = []
        for author in sorted(theirs):
            rows = np.frombuffer(theirs[author], DIGEST_ROW)
            ours = self._authors.get(author)
            newer = rows if ours is None else rows[_newer(rows, ours.sorted())]
            if len(newer):
                found.append((author, sorted(set(newer["tile"].tolist()))))
        return found

    def ahead(self, theirs: Held, authors: list[str]) -> list[tuple[str, list[int]]]:
        """(author, tiles) of these authors of which we hold a newer set than they."""
        found = []
        for author in authors:
            if author not in self._authors:
                continue
            rows = self._authors[author].sorted()
            if author in theirs:
                rows = rows[_newer(rows, np.sort(np.frombuffer(theirs[author], DIGEST_ROW)))]
            if len(rows):
                found.append((author, rows["tile"].tolist()))
        return found


class _Rows:
    """One author's rows, updated in place."""

    def __init__(self) -> None:
        self._place: dict[int, int] = {}
        self._rows: NDArray[np.void] = np.zeros(8, DIGEST_ROW)
        self._ordered = True

    def record(self, tile: int, epoch: int, seq: int) -> None:
        place = self._place.get(tile)
        if place is None:
            place = len(self._place)
            if place == len(self._rows):
                self._rows = np.concatenate([self._rows, np.zeros(place, DIGEST_ROW)])
            self._place[tile] = place
            self._ordered = self._ordered and (place == 0 or int(self._rows["tile"][place - 1]) < tile)
        self._rows[place] = (tile, epoch, seq)

    def record_many(self, tiles: list[int], epochs: ArrayLike, seqs: ArrayLike) -> None:
        """Tiles are all different."""
        new = [tile for tile in tiles if tile not in self._place]
        if new:
            count = len(self._place)
            self._place.update(zip(new, range(count, count + len(new)), strict=True))
            if count + len(new) > len(self._rows):
                self._rows = np.concatenate([self._rows, np.zeros(max(count, len(new)), DIGEST_ROW)])
            self._ordered = False
        place = self._place
        at = [place[tile] for tile in tiles]
        self._rows["tile"][at], self._rows["epoch"][at], self._rows["seq"][at] = tiles, epochs, seqs

    def drop(self, tile: int) -> int:
        """Returns how many are left."""
        if tile in self._place:
            self._rows = np.delete(self.sorted(), self._place[tile])
            self._place = {tile: place for place, tile in enumerate(self._rows["tile"].tolist())}
        return len(self._place)

    def of(self, tiles: Iterable[int]) -> NDArray[np.void]:
        return self._rows[[place for tile in sorted(tiles) if (place := self._place.get(tile)) is not None]]

    def sorted(self) -> NDArray[np.void]:
        if not self._ordered:
            count = len(self._place)
            self._rows[:count] = self._rows[np.argsort(self._rows["tile"][:count])]
            self._place = {tile: place for place, tile in enumerate(self._rows["tile"][:count].tolist())}
            self._ordered = True
        return self._rows[: len(self._place)]


def _newer(rows: NDArray[np.void], base: NDArray[np.void]) -> NDArray[np.bool_]:
    """Which of `rows` are newer than the row of the same tile in `base`, which is in order of tile."""
    if not len(base):
        return np.ones(len(rows), bool)
    # Of a garbled digest with a tile twice, the last and thus the newest row of `base` counts.
    place = np.searchsorted(base["tile"], rows["tile"], side="right") - 1
    there = base[np.maximum(place, 0)]
    known = (place >= 0) & (there["tile"] == rows["tile"])
    later = (rows["epoch"] > there["epoch"]) | ((rows["epoch"] == there["epoch"]) & (rows["seq"] > there["seq"]))
    return np.asarray(~known | later, bool)


def fingerprint(held: Held) -> str:
    """16 hex digits that are equal where holdings are."""
    hashed = hashlib.blake2b(digest_size=8)
    for author in sorted(held):
        hashed.update(f"{author}:{len(held[author])}:".encode())
        hashed.update(held[author])
    return hashed.hexdigest()
